"""Runs the commands of README.md: all code blocks marked ```sh, from top to bottom, in one shell, in the root folder.

usage: python tests/readme_commands.py [--done COMMAND]...      skips COMMAND, which has run already
"""

import argparse
import re
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def script(readme: str, done: list[str]) -> str:
    """Returns the commands as one shell script, which stops at the first failure."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", readme, flags=re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.partition("#")[0].strip() not in done]
    return "\n".join(["set -eux", *lines, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--done", action="append", default=[], metavar="COMMAND")
    commands = script((ROOT / "README.md").read_text(encoding="utf-8"), parser.parse_args().done)
    with tempfile.TemporaryDirectory() as checkout:  # the same files, without earlier runs
        for entry in ROOT.iterdir():
            if entry.name != "runs":
                (Path(checkout) / entry.name).symlink_to(entry)
        return subprocess.run(["bash", "-c", commands], cwd=checkout, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
