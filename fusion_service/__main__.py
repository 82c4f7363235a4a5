"""`python -m fusion_service` is the command `fusion-service`."""

from fusion_service.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
