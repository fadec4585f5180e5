"""Bags: rosbag2 recordings (MCAP and sqlite3) as one exact, ordered stream of messages."""

from rsltrace.trace.recordings.reader import Bag, open_bag
from rsltrace.trace.recordings.topic import DURATION_INFINITE_NS, BagQos, BagTopic

__all__ = ["DURATION_INFINITE_NS", "Bag", "BagQos", "BagTopic", "open_bag"]
