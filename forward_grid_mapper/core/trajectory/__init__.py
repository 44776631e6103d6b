"""SLAM: the trajectory is estimated together with the map, which removes the drift of odometry."""
