"""The ROS 2 node: a thin wrapper of the core. Importing this package does not need ROS; its modules do."""
