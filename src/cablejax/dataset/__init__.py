"""Data sets of cables moved at random: generated, stored in Zarr so that a kill costs nothing, read as windows."""
