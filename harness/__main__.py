"""The program's entry point, which takes signals before it imports the command line."""

from harness.core import process


def main() -> None:
    """Run the command that was typed."""
    process.run(_program)


def _program() -> None:
    from harness.cli import main

    main()


if __name__ == "__main__":
    main()
