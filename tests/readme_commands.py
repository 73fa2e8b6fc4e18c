"""Runs the commands of README.md and of the tutorials: all code blocks marked ```sh, page by page, from top to bottom.

Each page runs in one shell in a root folder without earlier runs.

usage: python tests/readme_commands.py [PAGE]... [--done COMMAND]...      skips COMMAND, which has run already
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "tutorials").glob("*.md"))]


def script(page: str, done: list[str]) -> str:
    """Returns the commands of a page as one shell script, which stops at the first failure."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.partition("#")[0].strip() not in done]
    return "\n".join(["set -eux", *lines, ""])


def run(page: Path, done: list[str]) -> int:
    """Returns the exit status of the commands of a page."""
    with tempfile.TemporaryDirectory() as checkout:  # the same files, without earlier runs
        for entry in ROOT.iterdir():
            if entry.name != "runs":
                (Path(checkout) / entry.name).symlink_to(entry)
        commands = script(page.read_text(encoding="utf-8"), done)
        return subprocess.run(["bash", "-c", commands], cwd=checkout, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path, default=PAGES)
    parser.add_argument("--done", action="append", default=[], metavar="COMMAND")
    arguments = parser.parse_args()
    for page in arguments.pages:
        start = time.monotonic()
        if status := run(page, arguments.done):
            print(f"{page}: failed with status {status}", file=sys.stderr)
            return status
        print(f"{page}: {time.monotonic() - start:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
