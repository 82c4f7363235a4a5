"""`python -m fusion_service.rules`, in a clone: the tables of README.md and docs/rules.md, made anew."""

from fusion_service.rules.face.table import main

main()
