"""Entry point of `python -m twin`, which is equivalent to the command `twin`."""

from twin.cli import main

if __name__ == "__main__":
    main()
