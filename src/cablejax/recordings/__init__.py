"""Readers of recorded cables: motion capture, photographs, csv and ROS 2 bags to gap logs."""
