"""The process of ``trackvib replay``: a player with pause and resume by key and by service."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from trackvib_ros.bag import BagReader
from trackvib_ros.process import IDLE_S, Stop
from trackvib_ros.replay import Player, ReplayOptions


def replay(bag: Path, options: ReplayOptions, show: Callable[[Player], None]) -> Player:
    """Publish a bag until its end or a signal; returns the player.

    Args:
        bag: directory or ``.mcap`` file.
        options: how to play.
        show: called when playing begins, and now and then meanwhile.

    Raises:
        InputError: not a bag, no such topic, a message that is not CDR.
    """
    reader = BagReader(bag)
    stop = Stop()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("trackvib_replay", start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    ended = threading.Event()
    try:
        player = Player(node, reader, options)
        _serve(node, player)

        def attend() -> None:
            with _keys() as pressed:
                while not ended.is_set():
                    executor.spin_once(timeout_sec=IDLE_S)
                    if pressed() == " ":
                        player.paused = not player.paused
                    show(player)

        attendant = threading.Thread(target=attend, name="attendant", daemon=True)
        attendant.start()
        try:
            player.play(lambda: not stop)
        finally:
            ended.set()
            attendant.join()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return player


def _serve(node: Node, player: Player) -> None:
    for name, action in (("pause", player.pause), ("resume", player.resume)):

        def handle(
            _: Trigger.Request,
            response: Trigger.Response,
            action: Callable[[], None] = action,
        ) -> Trigger.Response:
            action()
            response.success = True
            response.message = f"at log time {player.position_ns} ns"
            return response

        node.create_service(Trigger, f"~/{name}", handle)


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key pressed since its last call, or an empty text."""
    if not sys.stdin.isatty() or os.getpgrp() != os.tcgetpgrp(sys.stdin.fileno()):
        yield lambda: ""
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)

    def pressed() -> str:
        ready, _, _ = select.select([descriptor], [], [], 0)
        return os.read(descriptor, 1).decode("ascii", "replace") if ready else ""

    try:
        yield pressed
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
