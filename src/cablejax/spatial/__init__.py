"""Cables in space: recorded motion of real cables, a simulator for it, and the diagnosis of what is left."""
