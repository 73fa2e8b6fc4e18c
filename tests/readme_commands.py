"""Runs the commands of README.md: every block marked ```sh, top to bottom, in one shell, from the root.

usage: python tests/readme_commands.py [--done COMMAND]...      COMMAND has run already: it is skipped
"""

import argparse
import re
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def script(readme: str, done: list[str]) -> str:
    """The commands as one shell script that stops at the first that fails."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", readme, flags=re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.partition("#")[0].strip() not in done]
    return "\n".join(["set -eux", *lines, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--done", action="append", default=[], metavar="COMMAND")
    commands = script((ROOT / "README.md").read_text(encoding="utf-8"), parser.parse_args().done)
    with tempfile.TemporaryDirectory() as checkout:  # the same files, but no runs from before
        for entry in ROOT.iterdir():
            if entry.name != "runs":
                (Path(checkout) / entry.name).symlink_to(entry)
        return subprocess.run(["bash", "-c", commands], cwd=checkout, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
