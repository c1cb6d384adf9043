"""Cells with one arm: views from many sides, with nothing to be aligned."""
