"""Closed-loop shaping of a cable: controllers, the loop and its batched form, targets."""
