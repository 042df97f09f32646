"""Vehicle-track-bridge dynamics: hierarchical-beam FE extended to 5 kHz by SEA. No ROS here."""

from .errors import InputError, SolverError
from .scenario import (
    GRAVITY,
    Scenario,
    build_scenario,
    load_scenario,
    load_scenario_text,
    preset_names,
    preset_text,
    scenario_schema,
    train_preset,
)

__all__ = [
    "GRAVITY",
    "InputError",
    "Scenario",
    "SolverError",
    "build_scenario",
    "load_scenario",
    "load_scenario_text",
    "preset_names",
    "preset_text",
    "scenario_schema",
    "train_preset",
]
