"""Sonar occupancy grid maps with forward sensor models (Thrun 2003), for ROS 2 Jazzy.

Rooms, from the bottom up; each imports only from those above it in this list:

``core``        parameters, association of readings, cone index, EM, live map: numpy and numba only
``files``       map, report, picture and parameter files
``bags``        reading and writing of ROS 1 and ROS 2 bags through rosbags
``simulation``  worlds with a ground truth, simulated sonars, scores
``commands``    the command lines
"""

__version__ = '0.1.0'
