"""The planar chain with its time step in closed form: every effect of the library, batched and differentiable."""
