"""Vehicle-track-bridge dynamics: hierarchical-beam FE extended to 5 kHz by SEA. No ROS here."""

from .check import check_run
from .classes import ClassRun, run_classes
from .errors import InputError, SolverError
from .motion import TrainMotion
from .proofs import Proof, ensemble_proofs, hybrid_proofs, line_proofs
from .quality import QualityReport
from .scenario import (
    GRAVITY,
    Scenario,
    Sensor,
    Train,
    build_scenario,
    load_scenario,
    load_scenario_text,
    preset_names,
    preset_text,
    scenario_schema,
    train_preset,
)
from .simulation import Block, Simulation
from .statistics import wavelength_classes
from .validation import compare_models, ensemble_study
from .waves import pinned_pinned_frequency, rail_frequency

__all__ = [
    "GRAVITY",
    "Block",
    "ClassRun",
    "InputError",
    "Proof",
    "QualityReport",
    "Scenario",
    "Sensor",
    "Simulation",
    "SolverError",
    "Train",
    "TrainMotion",
    "build_scenario",
    "check_run",
    "compare_models",
    "ensemble_proofs",
    "ensemble_study",
    "hybrid_proofs",
    "line_proofs",
    "load_scenario",
    "load_scenario_text",
    "pinned_pinned_frequency",
    "preset_names",
    "preset_text",
    "rail_frequency",
    "run_classes",
    "scenario_schema",
    "train_preset",
    "wavelength_classes",
]
