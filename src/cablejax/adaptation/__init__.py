"""Online estimation of the cable: stiffness and friction, updated at every control step from the model's errors."""
