"""Measurements: accuracy by Monte Carlo with seeds, speed and memory by medians. Run as modules, see the README."""
