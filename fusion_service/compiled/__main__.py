"""`python -m fusion_service.compiled`: compile what is not compiled yet, and say which road there is."""

from fusion_service.compiled import use

if __name__ == "__main__":
    print(use("auto"))
