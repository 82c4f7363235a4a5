"""Hard worlds through the centre, beside an assignment that knows the truth: `python -m benchmarks.worlds`."""
