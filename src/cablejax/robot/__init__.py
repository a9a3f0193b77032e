"""Connects a controller to a robot: a run with its log, a socket server and a ROS 2 node."""
