"""Names of the topics, relative to the namespace of a site. No ROS."""

CLOCK = "/clock"
DIAGNOSTICS = "/diagnostics"
SCENARIO = "scenario"
CHANNELS = "channels"
MARKERS = "markers"
TRUE_ACCELERATION = "ground_truth/acceleration"
TRUE_WHEEL_FORCE = "ground_truth/wheel_force"
TRUE_WHEELSETS = "ground_truth/wheelsets"
TRUE_TRAIN = "ground_truth/train"
TRUE_PASSAGES = "ground_truth/passages"
TRAIN_EVENTS = "train/events"
TRAIN_OCCUPIED = "train/occupied"
TRAIN_SPEED = "train/speed"


def waveform(group: str) -> str:
    """Full-rate blocks of a sensor group."""
    return f"{group}/waveform"


def acceleration(channel: str) -> str:
    """Low-rate acceleration of a channel."""
    return f"{channel}/acceleration"


def wheel_force(number: int) -> str:
    """Low-rate force on a wheelset, counted from 1 within its train."""
    return f"wheel_force/wheelset_{number}"
