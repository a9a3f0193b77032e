"""Cables in space: recorded motion of real cables, its simulation, and the diagnosis of the remaining gap."""
