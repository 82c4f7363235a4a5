"""One file an experiment: a module here that has `STUDIES`, a tuple of `Study`, is found by itself."""
