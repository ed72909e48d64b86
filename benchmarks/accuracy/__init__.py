"""The parts of `benchmarks/accuracy_vs_time.py`: scenes, references, methods, experiments, plots and the table."""
