"""trackvib_ros: virtual trackside sensor, train detection, bags, ROS 2 nodes, command line."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("trackvib")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
