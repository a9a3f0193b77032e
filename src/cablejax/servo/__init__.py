"""Shaping without a model: visual servo with a deformation Jacobian that is estimated online."""

from cablejax.servo.visual_servo import ServoConfig, ServoInfo, ServoState, VisualServo, initial_state, servo

__all__ = ["ServoConfig", "ServoInfo", "ServoState", "VisualServo", "initial_state", "servo"]
