"""Where a sensor is, in the text of the topic ``channels``: no ROS."""

from __future__ import annotations

from collections.abc import Mapping

from solver import InputError, Scenario
from trackvib_ros.detection import Channel

EXACT = 0.001
"""Standard uncertainty (m) stated for simulated sensors: they are where the scenario has them."""


def channel_values(scenario: Scenario, name: str) -> dict[str, str]:
    """Layer, position and its uncertainty of a channel of a scenario, with units."""
    channel = next(c for c in scenario.channel if c.name == name)
    return {
        "layer": channel.layer,
        "x": f"{scenario.channel_x(channel)!r} m",
        "x_sigma": f"{EXACT} m",
    }


def read_channel(name: str, values: Mapping[str, str]) -> Channel:
    """The channel that such values describe; ``x_sigma`` may be missing.

    Raises:
        InputError: layer or position are missing or wrong.
    """
    try:
        x = float(values["x"].removesuffix(" m"))
        sigma = float(values["x_sigma"].removesuffix(" m")) if "x_sigma" in values else None
        return Channel(name, x, values["layer"], sigma)  # type: ignore[arg-type]
    except (KeyError, ValueError) as failure:
        raise InputError(f"channel description of {name!r}: {failure}") from None
