"""A newcomer's first hour, run: `python -m tests.newcomer`."""
