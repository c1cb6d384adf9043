"""Poses and ways, from the transforms believed so far; the truth of a simulation is not known here."""
