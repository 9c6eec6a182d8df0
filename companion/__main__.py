"""The command `companion`, also as `python -m companion`. Its modules are imported where Ctrl-C is already expected."""

import sys


def main() -> int:
    """Entry point of `companion`."""
    try:
        from companion.cli.main import main as run
    except KeyboardInterrupt:
        from companion.runtime.interrupt import interrupted

        return interrupted(sys.argv[1:])
    return run()


if __name__ == "__main__":
    sys.exit(main())
