"""``python -m probe2road``: the command line."""

from probe2road.cli.main import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
