"""Playing a recorded drive to the node."""
