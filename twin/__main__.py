"""Entry point of `python -m twin`, which is equivalent to the command `twin`."""

import os
import sys
from pathlib import Path

if __name__ == "__main__":
    # `python -m` searches the current folder first, which may have a folder named controllers, scenes or terrains
    root = str(Path(__file__).resolve().parents[1])
    sys.path.insert(0, root)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))  # of child processes

    from twin.cli import main

    main()
