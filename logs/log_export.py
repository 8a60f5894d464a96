"""Export a log: steps as CSV or as a Minari data set, MAVLink frames as .tlog, all messages with Foxglove scenes."""

from __future__ import annotations

import csv
import math
import re
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from google.protobuf.message import DecodeError

from brakeline.errors import ExportError, UnknownRobot
from brakeline.logs.foxglove import FoxgloveConverter
from brakeline.logs.reader import Log, Record
from brakeline.logs.segment import Entry, Segment, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.atomic_files import whole_or_nothing
from brakeline.messaging.robot import Robot
from brakeline.messaging.task import RobotWithTask, robot_maybe_with_task

BATCH = 1000  # messages per write
EPISODES_AT_ONCE = 100  # episodes per write of a Minari data set
# Fields of a step in the `infos` of a Minari data set.
INFOS = ("penalty", "goal", "collision", "decision", "clearance", "speed", "weights_version")
# Columns of a CSV file about the decision of a step, besides its kind.
DECISION_FIELDS = ("decision.verified", "decision.margin", "decision.model", "decision.reason")
MOST_WAITING = 1_000  # exchanges in memory whose step has not come
TIME = struct.Struct(">Q")  # of a frame in a .tlog file: µs since the Unix epoch


def robot_of_log(log: Log, name: str) -> Robot:
    """Return the robot with this name or description file. A robot of one's own needs only the log, which describes it.

    Args:
        name: if it is empty, the only robot with steps in the log; of several the ground robot.

    Raises:
        UnknownRobot: neither the program nor the log describes it.
        ExportError: the log has steps of several robots but no name was given.
        LogError: as `Log`.
    """
    if name:
        with suppress(UnknownRobot):
            return robot_maybe_with_task(name)
    whole = Log(log.paths)
    names = {channel.robot for channel, *_ in whole.rows() if channel.topic == "step"}
    wanted = name or (next(iter(names)) if len(names) == 1 else "ground")
    if not name and names and wanted not in names:
        raise ExportError(f"the log has steps of {', '.join(sorted(names))}: give --robot NAME")
    robot = whole.robots.named(wanted)
    return robot if robot is not None else robot_maybe_with_task(wanted)


def robot_steps(log: Iterable[Record], robot: Robot) -> Iterator[Record]:
    """Yield the steps of a robot kind in the order of receipt.

    Raises:
        ExportError: the log has no step of this robot; the message lists the robots that it has.
        LogError: as `Log`.
    """
    others, empty = set(), True
    for record in log:
        if record.topic == "step" and record.message.robot == robot.name:
            empty = False
            yield record
        elif record.topic == "step":
            others.add(record.message.robot)
    if empty and others:
        names = ", ".join(sorted(others))
        advice = "give one of these names with --robot"
        raise ExportError(f"the log has no step of {robot.name}, but steps of {names}: {advice}")
    if empty:
        raise ExportError(f"the log has no step of {robot.name} or of any other robot")


def to_csv(log: Log, robot: Robot, file: TextIO) -> int:
    """Write each step of a robot kind as a line, and return the number of steps. Raises as `robot_steps`.

    Columns: log_time [ns], header.time [s], header.source, header.run, header.sequence, the fields of the message
    but `path`, and `DECISION_FIELDS` of the decision that the step followed; vectors as `field.name [unit]`, the
    decision by its name. A robot without a task has no observations. Without requests in the log, `DECISION_FIELDS`
    are empty.
    """
    observed = robot.task.observed if isinstance(robot, RobotWithTask) else ()
    vectors = {
        **{"observation": observed, "proposed": robot.action, "action": robot.action},
        **{"next_observation": observed, "state": robot.state, "true_state": robot.state},
    }
    plain = [f.name for f in pb.Step.DESCRIPTOR.fields if not f.is_repeated and f.message_type is None]
    header = ["time", "source", "run", "sequence"]
    table = csv.writer(file, lineterminator="\n")
    titles = [f"{name}.{part}" for name, parts in vectors.items() for part in parts]
    table.writerow(["log_time", *(f"header.{name}" for name in header), *plain, *titles, *DECISION_FIELDS])
    count = 0
    for record, exchange in _steps_with_exchanges(log, robot):
        step = record.message
        values: list[Any] = [record.log_time, *(getattr(step.header, name) for name in header)]
        for name in plain:
            value = getattr(step, name)
            values.append(
                pb.Kind.Name(value) if name == "decision" else int(value) if isinstance(value, bool) else value
            )
        for name, parts in vectors.items():
            row = list(getattr(step, name))
            values += row if len(row) == len(parts) else [""] * len(parts)
        table.writerow([*values, *_decision_values(exchange)])
        count += 1
    return count


def _steps_with_exchanges(log: Log, robot: Robot) -> Iterator[tuple[Record, pb.Exchange | None]]:
    """Yield the steps of a robot kind, each with the exchange about it, which comes before its step in a log."""
    exchanges: dict[tuple[int, str, int, int], pb.Exchange] = {}

    def watched() -> Iterator[Record]:
        for record in log:
            if record.topic == "exchange" and (request := record.message.request).robot == robot.name:
                if len(exchanges) == MOST_WAITING:  # of steps that never came
                    del exchanges[next(iter(exchanges))]
                exchanges[record.message.header.run, request.actor, request.episode, request.step] = record.message
            yield record

    for record in robot_steps(watched(), robot):
        step = record.message
        yield record, exchanges.pop((step.header.run, step.actor, step.episode, step.step), None)


def _decision_values(exchange: pb.Exchange | None) -> list[Any]:
    """Return the values of `DECISION_FIELDS`, empty without an exchange. If no decision came, the reason says why."""
    if exchange is None:
        return [""] * len(DECISION_FIELDS)
    if exchange.failure:
        return [*[""] * (len(DECISION_FIELDS) - 1), exchange.failure]
    decision = exchange.reply.decision
    return [int(decision.verified), decision.margin, decision.model, decision.reason]


def to_tlog(log: Log, file: BinaryIO) -> int:
    """Write all MAVLink frames, each after its time, for ground stations and pymavlink; return their number.

    Raises:
        ExportError: the log has no frame.
        LogError: as `Log`.
    """
    frames = (frame for record in log if record.topic == "frames" for frame in record.message.frames)
    count = 0
    for frame in frames:
        file.write(TIME.pack(frame.wall_time // 1000) + frame.raw)
        count += 1
    if not count:
        raise ExportError("the log has no MAVLink frame: `brakeline train` records frames only with --mavlink")
    return count


def to_foxglove(log: Log, out: Path) -> int:
    """Write a log's messages to `out` with new Foxglove scenes of all steps, and return the number of messages.

    Raises:
        ExportError: `out` exists, or the log has no message.
        LogError: as `Log`.
        OSError: the disk is full or broken; no part of a file is left.
    """
    if out.exists():
        raise ExportError(f"{out} exists already")
    with whole_or_nothing(out) as path:
        return _write_scenes(log, path)


def _write_scenes(log: Log, out: Path) -> int:
    """Write what `to_foxglove` writes, to a new file."""
    converter = FoxgloveConverter(math.inf, log.robots)
    segment: Segment | None = None
    count = 0
    batch: list[Entry] = []
    try:
        for stored, record in _stored(log):
            if segment is None:  # the metadata come before the first message
                about = {name: values for name, values in log.metadata.items() if name != "brakeline"}
                segment = open_segment(out, about, log.attachments)
            batch += [stored, *converter.from_record(record)]
            if len(batch) >= BATCH:
                segment.save(batch)
                count, batch = count + len(batch), []
        if segment is None:
            raise ExportError("the log holds no message")
        segment.save(batch)
        segment.finish()
    except OSError:
        if segment is not None:
            segment.abandon()
        raise
    return count + len(batch)


def _stored(log: Log) -> Iterator[tuple[Entry, Record]]:
    """Yield the messages of a log, as stored and decoded."""
    for channel, log_time, publish_time, payload in log.rows():
        try:
            message: Any = channel.decode(payload)
        except DecodeError:
            log.malformed += 1
            continue
        entry = Entry(channel.key, type(message), payload, log_time, publish_time, message.header.sequence)
        yield entry, Record(channel.topic, channel.key, message, log_time, publish_time)


def episodes(log: Log, robot: RobotWithTask) -> Iterator[list[pb.Step]]:
    """Yield the consecutive steps of each episode of each actor, in the order of the episodes' ends.

    A lost step splits an episode into parts; the last step of an incomplete part does not end the episode. Duplicate
    steps are skipped.
    """
    running: dict[str, list[pb.Step]] = {}
    for record in robot_steps(log, robot):
        step: pb.Step = record.message
        if step.lost:  # it shows nothing about its action
            continue
        steps = running.setdefault(step.actor, [])
        if steps:
            last = steps[-1]
            current, previous = (step.episode, step.step), (last.episode, last.step)
            if step.header.run == last.header.run and current <= previous:
                continue
            if current != (previous[0], previous[1] + 1) or step.header.run != last.header.run:
                yield steps
                steps = running[step.actor] = []
        steps.append(step)
        if step.terminated or step.truncated:
            yield steps
            running[step.actor] = []
    yield from (steps for steps in running.values() if steps)


def to_minari(log: Log, robot: RobotWithTask, name: str) -> dict[str, Any]:
    """Write the episodes of a robot kind as the local Minari data set `name`, e.g. "brakeline/ground-v0".

    Returns:
        `path`, and the numbers of `episodes` and `steps`.

    Actions are the executed ones; rewards have no intervention penalty. `infos` has the proposed actions, the penalty
    and the decisions. The last step of an incomplete episode is truncated. The data set is in
    `$MINARI_DATASETS_PATH`, by default ~/.minari/datasets.

    Raises:
        ExportError: the data set exists, or its name has no version. The log has no step of this robot, or one without
            the observation of the robot's task.
        LogError: as `Log`.
    """
    import gymnasium
    import minari
    from minari.storage.datasets_root_dir import get_dataset_path

    if re.search(r"-v\d+$", name) is None:
        raise ExportError(f"the Minari data set {name!r}: end its name in -v<number>, as in brakeline/ground-v0")
    path = Path(get_dataset_path(name))
    if path.exists():
        raise ExportError(f"{path} exists already: give another name, e.g. with the next -v<number>")
    about: dict[str, Any] = {
        "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (robot.task.observation_dim,), np.float32),
        "action_space": gymnasium.spaces.Box(robot.low().astype(np.float32), robot.high().astype(np.float32)),
        "algorithm_name": "logged by brakeline",
        "author": "brakeline",
        "author_email": "none",
        "code_permalink": "none",
        "description": f"{robot.name}: observation {robot.task.observed}; action {robot.action}",
    }
    all_episodes = episodes(log, robot)
    dataset: Any = None
    count = steps = 0
    while batch := [
        _buffer(number, episode, robot.task.observation_dim)
        for number, episode in enumerate(islice(all_episodes, EPISODES_AT_ONCE), count)
    ]:
        if dataset is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # the data set has no registered environment
                dataset = minari.create_dataset_from_buffers(name, batch, **about)
        else:
            dataset.update_dataset_from_buffer(batch)
        count += len(batch)
        steps += sum(len(buffer.rewards) for buffer in batch)
    return {"path": str(path), "episodes": count, "steps": steps}


def _buffer(number: int, steps: list[pb.Step], dim: int) -> Any:
    from minari.data_collector import EpisodeBuffer

    observations = [steps[0].observation, *(step.next_observation for step in steps)]
    if any(len(observation) != dim for observation in observations):
        raise ExportError(f"a step without the {dim} observed values of the task, such as one of a program: give --csv")
    truncations = [step.truncated for step in steps]
    truncations[-1] |= not steps[-1].terminated
    infos = {name: np.array([getattr(step, name) for step in steps]) for name in INFOS}
    return EpisodeBuffer(
        id=number,
        observations=np.array(observations, np.float32),
        actions=np.array([step.action for step in steps], np.float32),
        rewards=[step.reward for step in steps],
        terminations=[step.terminated for step in steps],
        truncations=truncations,
        infos=infos | {"proposed": np.array([step.proposed for step in steps], np.float32)},
    )
