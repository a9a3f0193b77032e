"""Benchmark of the diagnosis in space on recordings of real and synthetic cables, and corrections learned on top."""
