"""Arguments of a node's command line, checked before ROS reads them, so that none is ignored."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node

from monoforce_ros.core import most_similar, nearest
from monoforce_ros.nodes.parameter_files import (
    read_sections,
    refuse_misnamed_sections,
    refuse_overridden_sections,
    section_matches,
)
from monoforce_ros.nodes.schema import no_parameters, of_every_node, parameter_owners


def seconds(text: str) -> float:
    """Type of an option: a finite time of 0 s or more, up to a year."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 365 * 86400.0:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number of seconds, 0 or more")
    return value


def seed(text: str) -> int:
    """Type of an option: the seed of a random generator."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"got {text!r}, expected an integer, 0 or more")
    return int(text)


def topic_name(text: str) -> str:
    """Type of an option: a topic's name as ROS allows it."""
    try:
        expand_topic_name(text, "node", "/")
    except ValueError as error:
        # rcl's messages end with the place in its source code.
        reason = str(error).partition(", at /")[0].partition(": ")[2]
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a topic such as '/odom': {reason}") from error
    return text


def own_arguments(arguments: Sequence[str]) -> list[str]:
    """The words of a command line that are not between ``--ros-args`` and ``--``.

    ROS's own function also takes ``NAME:=VALUE`` outside of them, as a remapping that nothing asked for, and fails on
    arguments that it cannot read.
    """
    own, of_ros = [], False
    for word in arguments:
        if word == "--ros-args" or (of_ros and word == "--"):
            of_ros = not of_ros or word == "--ros-args"
        elif not of_ros:
            own.append(word)
    return own


def refuse_stray_arguments(arguments: Sequence[str], parameters: Iterable[str]) -> None:
    """Raise ``ValueError`` for an argument that is neither ROS's own nor ``--help``.

    Args:
        arguments: the command line without the executable.
        parameters: names of the node's parameters, to suggest the one that was meant.
    """
    stray = own_arguments(arguments)
    if not stray:
        return
    word = stray[0]
    name = word.lstrip("-").replace("-", "_").partition("=")[0].rstrip(":")
    meant = next(iter(most_similar(name, parameters)), "NAME")
    raise ValueError(f"unexpected argument {word!r}: parameters are given as --ros-args -p {meant}:=VALUE")


def check_parameter_files(arguments: Sequence[str], node: str) -> list[str]:
    """Warnings about parameter files on the command line without a section for the node.

    Args:
        arguments: the command line.
        node: fully qualified name of the node.

    Raises:
        ValueError: a file is missing, is no parameter file, or has a section that is misnamed or overrides another.
    """
    warnings = []
    for path in parameter_files(arguments):
        sections = read_sections(path)
        others = {name: values for name, values in sections.items() if not section_matches(name, node)}
        refuse_misnamed_sections(path, others, [node])
        refuse_overridden_sections(path, sections, [node])
        if not any(section_matches(section, node) for section in sections):
            warnings.append(
                f"{path} has no parameters for {node}: its sections are {', '.join(sorted(sections))}; expected {node} "
                "or /**"
            )
    return warnings


def refuse_other_nodes(arguments: Sequence[str], node: str) -> None:
    """Raise ``ValueError`` for a parameter or remapping that is for a node of another name, which ROS ignores.

    Args:
        arguments: the command line, with ``-p NODE:NAME:=VALUE`` and ``-r NODE:FROM:=TO``.
        node: fully qualified name of the only node of the process.
    """
    for option, word in pairwise(arguments):
        if option not in ("-p", "--param", "-r", "--remap"):
            continue
        prefix, sign, rest = word.partition(":=")[0].partition(":")
        # `rostopic://` and the like are no node names.
        if not sign or rest.startswith("/"):
            continue
        bare = node.rpartition("/")[2]
        wanted = (f"/{prefix.lstrip('/')}", node) if option in ("-p", "--param") else (prefix, bare)
        if wanted[0] != wanted[1]:
            how = word.removeprefix(f"{prefix}:")
            raise ValueError(f"{option} {word}: the node is {node}, not {prefix!r}; give {option} {how}")


def refuse_given_parameters(arguments: Sequence[str], node: str, known: Iterable[str] = ()) -> None:
    """Raise ``ValueError`` for ``-p NAME:=VALUE`` with a parameter that the node does not have.

    Parameters of the package's other nodes are refused, too: in a file they may stand, which several nodes share, but
    the command line is meant for this node.

    Args:
        arguments: the command line.
        node: name of the executable.
        known: names of the node's parameters.
    """
    known, owners = set(known), parameter_owners()
    for option, word in pairwise(arguments):
        before, sign, _ = word.partition(":=")
        name = before.rpartition(":")[2]
        if option not in ("-p", "--param") or not sign:
            continue
        if name in known or of_every_node(name):
            continue
        if not known:
            raise ValueError(f"unknown parameter {name!r}: {no_parameters(node)}")
        owner = f" (it is one of {owners[name]})" if name in owners else ""
        meant = nearest(name, known | {"use_sim_time"}) or ";"
        raise ValueError(f"unknown parameter {name!r}{owner}{meant} --help lists all parameters")


def idle_remappings(arguments: Sequence[str], node: Node) -> list[str]:
    """Warnings about remappings of the command line that rename nothing, such as a misspelt topic.

    Args:
        arguments: the command line.
        node: the node, with all its topics.
    """
    topics = {publisher.topic_name for publisher in node.publishers}
    topics |= {subscription.topic_name for subscription in node.subscriptions}
    others = {service.srv_name for service in node.services} | {client.srv_name for client in node.clients}
    found = []
    for option, word in pairwise(arguments):
        before, sign, after = word.partition(":=")
        # Names of nodes and namespaces, schemes such as rostopic://, and what ROS itself refuses.
        if option not in ("-r", "--remap") or not sign or before.startswith("__") or "://" in before:
            continue
        name, space = node.get_name(), node.get_namespace()
        try:
            old, new = (expand_topic_name(text, name, space) for text in (before.rpartition(":")[2], after))
        except ValueError:
            continue
        # Services of every node, of parameters and lifecycles, are not listed above.
        if new in topics | others or old.startswith(f"{node.get_fully_qualified_name()}/"):
            continue
        full_name = node.get_fully_qualified_name()
        found.append(f"-r {word} renames nothing: {full_name} has no topic {old}{nearest(old, topics)}")
    return found


def parameter_files(arguments: Sequence[str]) -> list[Path]:
    """Files given by ``--params-file``."""
    return [Path(path) for word, path in pairwise(arguments) if word == "--params-file"]


def command_line(arguments: Sequence[str] | None) -> list[str]:
    """The given arguments, or those of the process without the executable."""
    return list(sys.argv[1:] if arguments is None else arguments)
