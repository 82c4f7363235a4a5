"""`python -m studies`."""

import sys


def _main() -> int:
    try:
        from studies.cli import main  # slow to import: a signal may come before it is done

        return main()
    except KeyboardInterrupt:
        print("stopped: no result of what was running is kept", file=sys.stderr)
        return 1


if __name__ == "__main__":
    raise SystemExit(_main())
