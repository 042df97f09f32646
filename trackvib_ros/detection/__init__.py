"""Train detection on streams of waveform blocks: pure NumPy and SciPy.

Five lines from arrays::

    from trackvib_ros.detection import Channel, detect

    events = detect(2000.0, samples, [Channel("rail", 0.0, "rail")])
    passages = [event for event in events if event.kind == "passage"]
    print(passages[0].values["speed"], passages[0].values["type"])
"""

from .arrays import detect
from .calibration import Calibration
from .catalogue import Catalogue, TrainType
from .detector import DetectorConfig, TrainDetector
from .events import (
    CONFIRMED,
    POSITION_SIGMA,
    POSITION_SIGMA_RANGE,
    VIBRATION,
    Channel,
    Estimate,
    TrainEvent,
)

__all__ = [
    "CONFIRMED",
    "POSITION_SIGMA",
    "POSITION_SIGMA_RANGE",
    "VIBRATION",
    "Calibration",
    "Catalogue",
    "Channel",
    "DetectorConfig",
    "Estimate",
    "TrainDetector",
    "TrainEvent",
    "TrainType",
    "detect",
]
