"""The `dualcal` command line and the benchmarks."""
