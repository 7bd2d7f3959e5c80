import analysis  # noqa: F401  # which answers signals while the libraries of `python -m figures.NAME` are loaded
