"""The ROS 2 environment of a process: found, checked, completed. Importable without ROS."""

from __future__ import annotations

import importlib.util
import os
import random
import socket
import sys
from collections.abc import Mapping, MutableMapping
from importlib import resources

from solver import InputError

DOMAINS = range(1, 102)
"""Domains whose ports stay clear of the ephemeral ones of Linux."""


def require_ros(environment: Mapping[str, str] = os.environ) -> None:
    """Refuse to go on without a usable rclpy.

    Raises:
        InputError: rclpy is not installed, or two installations are mixed.
    """
    found = importlib.util.find_spec("rclpy")
    if found is None or found.origin is None:
        raise InputError(
            "ROS 2 is not installed for this Python: install the extra with "
            'pip install "trackvib[ros]", or use the Python of a sourced ROS 2 Jazzy'
        )
    mine = found.origin.startswith(sys.prefix + os.sep)
    foreign = [
        path
        for path in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        if os.path.isdir(os.path.join(path, "share", "rclpy"))  # noqa: PTH112, PTH118
        and os.path.realpath(path) != os.path.realpath(sys.prefix)
    ]
    if mine and foreign and environment.get("_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        raise InputError(
            f"the ROS installation {foreign[0]} is sourced in this shell, but rclpy comes from "
            f"the wheels in {sys.prefix}; both together crash: open a shell that does not source "
            "it, or use a Python without the wheels"
        )
    rmw = environment.get("RMW_IMPLEMENTATION", "")
    if mine and rmw not in ("", "rmw_fastrtps_cpp"):
        raise InputError(
            f"RMW_IMPLEMENTATION = {rmw}: the installed wheels bring rmw_fastrtps_cpp only; "
            "unset the variable"
        )


def domain_of(environment: Mapping[str, str]) -> int | None:
    """The ROS domain that the environment states, None if it states none.

    Raises:
        InputError: it is no number from 0 to 101.
    """
    text = environment.get("ROS_DOMAIN_ID", "").strip()
    if not text:
        return None
    if not text.isascii() or not text.isdigit() or int(text) > 101:
        raise InputError(f"ROS_DOMAIN_ID = {text!r}: must be a whole number from 0 to 101")
    return int(text)


def _in_use(domain: int) -> bool:
    """Whether a participant of this machine has the domain's first discovery port (RTPS 9.6.1)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * domain + 10))
        except OSError:
            return True
    return False


def free_domain() -> int:
    """A random domain that nobody on this machine uses.

    Raises:
        InputError: all are in use.
    """
    for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
        if not _in_use(domain):
            return domain
    raise InputError("ROS domains 1 to 101 are all in use on this machine: set ROS_DOMAIN_ID")


def profile_path() -> str:
    """The shipped Fast DDS profile: announcements at the start, bounded histories."""
    return str(resources.files("trackvib_ros").joinpath("config").joinpath("dds_profile.xml"))


def complete(environment: MutableMapping[str, str]) -> None:
    """Add what a node of ours likes to have and the user has not decided otherwise."""
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", profile_path())
    if "HOME" not in environment:
        environment.setdefault("ROS_LOG_DIR", "/tmp")
