"""Bags: rosbag2 directories of MCAP files, written, read and recovered without ROS."""

from trackvib_ros.bag.definitions import message_definition, type_hash
from trackvib_ros.bag.metadata import Qos, Topic
from trackvib_ros.bag.reader import BagMessage, BagReader, TopicInfo
from trackvib_ros.bag.recovery import BagInUseError, RecoveryReport, recover, recover_file
from trackvib_ros.bag.writer import BagWriter

__all__ = [
    "BagInUseError",
    "BagMessage",
    "BagReader",
    "BagWriter",
    "Qos",
    "RecoveryReport",
    "Topic",
    "TopicInfo",
    "message_definition",
    "recover",
    "recover_file",
    "type_hash",
]
