"""The papers' experiments and our own, by Monte Carlo: `python -m studies list`, `python -m studies run NAME`.

One file an experiment in `experiments/`; `study` says what a study is, `rules` how a fusion rule is named on the
command line (one of ours with its options, or a function in a file of yours), `statistics` how an error is stated.
Studies measure accuracy; speed is measured in `benchmarks/`.
"""
