"""Entry point of `python -m twin`, which runs the command line `twin`."""

from twin.cli import main

if __name__ == "__main__":
    main()
