"""What cable is this? A belief about stiffness and friction, updated at every control step from the model's errors."""
