"""Sonar occupancy grid maps with forward sensor models (Thrun 2003), for ROS 2 Jazzy.

Layers, from the bottom up; each imports only from those that stand above it in this list:

``core``        from messages to maps: pose association, sensor model, search, learning; numpy and numba only
``files``       map, report, picture, journal and parameter files
``bags``        reading and writing of ROS 1 and ROS 2 bags through rosbags
``simulation``  worlds with a ground truth, simulated sonars, scores
``recordings``  recorded drives, from bags and journals, as readings
``replay``      playing a recorded drive to the node
``node``        the ROS 2 node
``commands``    the command lines
"""

__version__ = '0.1.0'
