"""Fusing mixtures by a rule: the checks, the blocks, the reduction of what comes out."""
