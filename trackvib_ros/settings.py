"""Parameters of the nodes: only what is about running; physics is in the scenario."""

from rclpy.parameter import Parameter

from trackvib_ros.detection import POSITION_SIGMA, POSITION_SIGMA_RANGE
from trackvib_ros.process import Setting

DAY = 86400.0
SENSOR_SETTINGS = (
    Setting("autostart", False, "configure and activate at once", read_only=True),
    Setting("exit_at_end", False, "end the process when the run is over", read_only=True),
    Setting("scenario", "demo", "scenario preset or TOML file", fixed=True),
    Setting("seed", -1, "seed of the next run, -1 is the scenario's", -1, 2**31 - 1),
    Setting("real_time_factor", 1.0, "simulated s per s; 0: all haste, no loss [-]", 0.0, 1000.0),
    Setting("ground_truth", True, "publish ground_truth/...", fixed=True),
    Setting("await_detectors", 0, "detectors to wait for at the start", 0, 100, fixed=True),
    Setting("await_recorders", 0, "subscribers of all data to wait for", 0, 100, fixed=True),
    Setting("step_duration", 1.0, "simulated time of service step [s]", 0.001, 3600.0),
    Setting("trigger_train", "", "train preset of trigger_passage; empty: the scenario's first"),
    Setting("trigger_speed", 0.0, "its speed, 0 is that of the scenario [m/s]", 0.0, 200.0),
    Setting("headway_mean", 0.0, "endless trains: mean random headway [s]", 0.0, DAY, fixed=True),
    Setting("headway_least", 60.0, "added to each random headway [s]", 5.0, DAY, fixed=True),
)

TEXTS = Parameter.Type.STRING_ARRAY
NUMBERS = Parameter.Type.DOUBLE_ARRAY
DETECTOR_SETTINGS = (
    Setting("autostart", False, "configure and activate at once", read_only=True),
    Setting("channel_names", TEXTS, "accelerometers; none: from topic channels", fixed=True),
    Setting("channel_positions", NUMBERS, "their x along the track [m]", fixed=True),
    Setting("channel_layers", TEXTS, "rail, slab, support_layer or bridge; each", fixed=True),
    Setting("channel_topics", TEXTS, "waveform topic of each", fixed=True),
    Setting(
        "channel_position_sigma", POSITION_SIGMA, "of x [m]", *POSITION_SIGMA_RANGE, fixed=True
    ),
    Setting("best_effort", False, "subscribe to best-effort publishers too", fixed=True),
    Setting("calibration_file", "", "keeps what passages teach; empty: nothing", fixed=True),
    Setting("record_directory", "", "record all topics to this new bag; empty: no", fixed=True),
)
