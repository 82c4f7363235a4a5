"""Searches for weights that are best under a criterion, for many fusions at once."""
