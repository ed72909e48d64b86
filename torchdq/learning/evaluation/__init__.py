"""Evaluation of logs and models: diagnostics, blocks of samples, correlation and coverage."""
