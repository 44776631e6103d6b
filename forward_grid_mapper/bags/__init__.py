"""Reads and writes recorded messages: ROS 2 mcap and sqlite3 bags, ROS 1 bags."""

from .choice import Topics
from .reader import Bag
from .static_transforms import StaticTransforms
from .writer import BagWriter

__all__ = ['Bag', 'BagWriter', 'StaticTransforms', 'Topics']
