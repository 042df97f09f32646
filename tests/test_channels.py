"""What the topic ``channels`` says of a sensor's place, written and read."""

import pytest

from solver import InputError, load_scenario
from trackvib_ros.channels import EXACT, channel_values, read_channel
from trackvib_ros.detection import Channel


def test_a_simulated_sensor_is_where_the_scenario_has_it():
    scenario = load_scenario("demo")
    for channel in scenario.channel:
        if channel.quantity != "acceleration":
            continue
        told = read_channel(channel.name, channel_values(scenario, channel.name))
        assert told == Channel(channel.name, scenario.channel_x(channel), channel.layer, EXACT)


def test_an_uncertainty_may_be_left_to_the_detector():
    told = read_channel("north", {"layer": "rail", "x": "12.5 m"})
    assert told == Channel("north", 12.5, "rail", None)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"layer": "rail"}, "'x'"),
        ({"x": "1 m"}, "'layer'"),
        ({"layer": "rail", "x": "far"}, "far"),
        ({"layer": "roof", "x": "1 m"}, "layer = 'roof'"),
        ({"layer": "rail", "x": "1 m", "x_sigma": "0.0 m"}, "position_sigma = 0.0 m must lie"),
    ],
)
def test_what_describes_no_channel_is_refused(values, said):
    with pytest.raises(InputError, match=f"north.*{said}"):
        read_channel("north", values)
