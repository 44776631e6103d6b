"""From ROS messages, in any order, to readings in the map frame."""
