"""Trajectory and map together: the drift of odometry is taken out by matching sonar with local maps."""
