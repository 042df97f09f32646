"""Commands that need ROS 2: demo, sensor, detect."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from solver import InputError, load_scenario
from trackvib_ros import environment

ScenarioOption = Annotated[
    str, typer.Option("--scenario", "-s", help="Scenario preset or TOML file.")
]
FactorOption = Annotated[
    float,
    typer.Option(
        "--real-time-factor",
        min=0,
        max=1000,
        help="Simulated seconds per second; 0: as fast as nothing is lost.",
    ),
]


def demo(
    scenario: ScenarioOption = "demo",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="New directory; by default named after the time."),
    ] = None,
    real_time_factor: FactorOption = 0.0,
    figure: Annotated[bool, typer.Option(help="Draw the passage as PNG.")] = True,
) -> None:
    """Let a train cross the bridge, sense, detect and record it: the whole product at once.

    Two processes, sensor and detector, talk over DDS on this machine only, in a ROS domain of
    their own unless ROS_DOMAIN_ID is set. At the end: detected vs truth, the bag, a figure.
    """
    environment.require_ros()
    domain = environment.domain_of(os.environ)
    load_scenario(scenario)
    if not Path(scenario).suffix:
        name = scenario
    else:
        name, scenario = Path(scenario).stem, str(Path(scenario).resolve())
    directory = output or Path(f"trackvib_demo_{name}_{datetime.now():%Y-%m-%d_%H-%M-%S}")
    if directory.exists():
        raise InputError(f"{directory} exists: name another directory with -o")
    os.environ["ROS_DOMAIN_ID"] = str(environment.free_domain() if domain is None else domain)
    environment.complete(os.environ)
    from trackvib_ros.demo import run_demo

    status = run_demo(
        scenario,
        directory.resolve(),
        os.environ,
        real_time_factor=real_time_factor,
        figure=figure,
        console=Console(),
    )
    raise typer.Exit(status)


def _node(module: str, parameters: dict[str, object], namespace: str) -> None:
    environment.require_ros()
    environment.domain_of(os.environ)
    environment.complete(os.environ)
    site = "/" + namespace.strip("/")
    # simulated time is the site's own: two sites in one domain do not mix
    arguments = ["trackvib", "--ros-args", "-r", f"__ns:={site}", "-r", "/clock:=clock"]
    for name, setting in parameters.items():
        text = str(setting).lower() if isinstance(setting, bool) else str(setting)
        arguments += ["-p", f"{name}:={text}"]
    from trackvib_ros.process import main

    if module == "sensor":
        from trackvib_ros.sensor_node import SensorNode as Node
    else:
        from trackvib_ros.detector_node import DetectorNode as Node
    main(Node, arguments)


NamespaceOption = Annotated[
    str,
    typer.Option("--namespace", "-n", help="ROS namespace of the site; /clock moves into it."),
]


def sensor(
    scenario: ScenarioOption = "demo",
    real_time_factor: FactorOption = 1.0,
    namespace: NamespaceOption = "",
    headway: Annotated[
        float, typer.Option(min=0, help="Mean random headway of endless further trains [s].")
    ] = 0.0,
) -> None:
    """Run the sensor node: publish a scenario, own /clock, until Ctrl-C."""
    load_scenario(scenario)
    if Path(scenario).suffix:
        scenario = str(Path(scenario).resolve())
    _node(
        "sensor",
        {
            "autostart": True,
            "scenario": scenario,
            "real_time_factor": real_time_factor,
            "headway_mean": float(headway),
        },
        namespace,
    )


def detect(
    record: Annotated[
        Path | None, typer.Option("--record", "-o", help="Record all topics to this new bag.")
    ] = None,
    namespace: NamespaceOption = "",
    sim_time: Annotated[bool, typer.Option(help="Take the time from /clock.")] = True,
) -> None:
    """Run the detector node on the waveforms of a namespace, until Ctrl-C."""
    if record is not None and record.exists():
        raise InputError(f"{record} exists: name another directory")
    parameters: dict[str, object] = {"autostart": True, "use_sim_time": sim_time}
    if record is not None:
        parameters["record_directory"] = record.resolve()
    _node("detector", parameters, namespace)


def register(app: typer.Typer) -> None:
    """Add this group's commands to the application."""
    app.command()(demo)
    app.command()(sensor)
    app.command()(detect)
