"""Parameter files: generated from a schema with every default, and read as ROS reads them.

``python -m monoforce_ros.nodes.parameter_files`` writes ``config/*.params.yaml`` of the current folder.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from monoforce_ros.core import most_similar, nearest, write_text
from monoforce_ros.nodes.schema import SCHEMAS, ParameterEntry, read_schema, schema_path

_WIDTH = 110


def parameter_file_text(node: str, entries: Sequence[ParameterEntry]) -> str:
    """A commented file with every parameter of a node at its default, for any node name and namespace."""
    lines = [
        f"# Parameters of the {node} with their defaults. Copy the file, delete what you do not change, and use it by",
        f"#   ros2 run monoforce_ros {node} --ros-args --params-file FILE",
        f"# Generated from {node}.schema.yaml by: python -m monoforce_ros.nodes.parameter_files",
        "/**:",
        "  ros__parameters:",
    ]
    for entry in entries:
        limits = f" [{entry.unit}]" if entry.unit else ""
        limits += f" ({entry.range_text})" if entry.range_text else ""
        live = " Can be changed while the node runs." if entry.dynamic else ""
        text = f"{entry.description}{limits}{live}"
        lines += textwrap.wrap(text, _WIDTH, initial_indent="    # ", subsequent_indent="    # ")
        if entry.default is None:
            example = ", ".join(["0.0"] * max(entry.size, 1))
            lines.append(f"    # {entry.name}: [{example}]")
        else:
            lines.append(f"    {entry.name}: {_yaml(entry.default)}")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """A value in YAML on one line, which ROS's own parser reads with the same type."""
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def read_sections(path: Path) -> dict[str, dict[str, Any]]:
    """Sections of a parameter file: fully qualified node name, possibly with wildcards → parameters.

    Nested keys such as ``left: predictor:`` are joined, and a name without a leading slash gets one, as ROS does.

    Raises:
        ValueError: the file is missing, not YAML, or has no ``ros__parameters``.
    """
    example = (
        "expected '/**:', under it 'ros__parameters:', and under that NAME: VALUE, as in config/predictor.params.yaml"
    )
    try:
        text = path.read_text(encoding="utf-8")
        _refuse_repeated_keys(yaml.compose(text, yaml.SafeLoader))
        content = yaml.safe_load(text)
    except OSError as error:
        raise ValueError(f"parameter file {path}: {error.strerror}; give the path of an existing file") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        problem = error.problem if isinstance(error, RepeatedKeyError) else f"is not YAML: {_problem(error)}"
        raise ValueError(f"parameter file {path} {problem}") from error
    sections: dict[str, dict[str, Any]] = {}
    stray: list[str] = []
    _collect(content, "", sections, stray)
    if not sections:
        raise ValueError(f"parameter file {path} has no 'ros__parameters': {example}")
    if stray:
        raise ValueError(f"parameter file {path}: {stray[0]} is not under 'ros__parameters': {example}")
    return sections


def _problem(error: Exception) -> str:
    """What is wrong with a file in one line: YAML's own message draws the place."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return str(error)
    begun = f", {error.context} that begins in line {error.context_mark.line + 1}" if error.context_mark else ""
    return f"line {error.problem_mark.line + 1}: {error.problem}{begun}"


class RepeatedKeyError(yaml.YAMLError):
    """A key that occurs twice in one mapping."""

    def __init__(self, key: object, line: int):
        self.problem = f"has {key!r} twice, again in line {line}: merge both into one"
        super().__init__(self.problem)


def _refuse_repeated_keys(node: yaml.Node | None) -> None:
    """Raise :class:`RepeatedKeyError` for a key that occurs twice in a mapping, of which YAML keeps the last one."""
    if isinstance(node, yaml.SequenceNode):
        for entry in node.value:
            _refuse_repeated_keys(entry)
    if not isinstance(node, yaml.MappingNode):
        return
    keys = [key.value for key, _ in node.value]
    for number, (key, value) in enumerate(node.value):
        # Equal scalars are equal texts; a key that is a list is none of ROS's.
        if keys[number] in keys[:number]:
            raise RepeatedKeyError(key.value, key.start_mark.line + 1)
        _refuse_repeated_keys(value)


def _collect(content: Any, name: str, sections: dict[str, dict[str, Any]], stray: list[str]) -> None:
    """Find the sections, and what is beside them instead of in one."""
    if not isinstance(content, Mapping):
        if name and content is not None:
            stray.append(f"'{name.rpartition('/')[2]}: {content}'")
        return
    for key, value in content.items():
        if key == "ros__parameters":
            if value is not None and not isinstance(value, Mapping):
                stray.append(f"'{value}'")
            sections[name or "/**"] = dict(value) if isinstance(value, Mapping) else {}
        else:
            _collect(value, f"{name}/{str(key).strip('/')}", sections, stray)


_TELLING = 3
"""Number of parameters that are all known here from which on a section is meant for this package."""


def refuse_misnamed_sections(path: Path, sections: Mapping[str, Mapping[str, Any]], nodes: Sequence[str]) -> None:
    """Raise ``ValueError`` for a section that is meant for a node of this package and reaches none.

    A file may also have sections for nodes of other packages, and for this package's nodes in other namespaces. A
    section is taken for a misnamed one if its name resembles that of a node, or if this package's nodes have all
    parameters in it and these are several: one or two, such as ``rate``, may be another package's.

    Args:
        path: the file, for the message.
        sections: its sections that match none of the nodes.
        nodes: fully qualified names of the nodes that are started.
    """
    own = {name.rpartition("/")[2] for name in nodes} | set(SCHEMAS)
    known = {entry.name for node in SCHEMAS for entry in read_schema(schema_path(node))}
    for section, values in sections.items():
        name = section.rpartition("/")[2]
        if name in own or "*" in name:
            continue
        if most_similar(name, own) or (len(values) >= _TELLING and set(values) <= known):
            meant = nearest(name, own)
            raise ValueError(
                f"parameter file {path}: no node is called {section}{meant or f'; expected {nodes[0]} or /**'}"
            )


def refuse_overridden_sections(path: Path, sections: Mapping[str, Mapping[str, Any]], nodes: Sequence[str]) -> None:
    """Raise ``ValueError`` for a section for several nodes that changes what an earlier section says for one of them.

    ROS takes the sections in the order of the file, so that the general value would win.

    Args:
        path: the file, for the message.
        sections: its sections, in their order.
        nodes: fully qualified names that one node answers to.
    """
    own: dict[str, tuple[str, Any]] = {}
    for section, values in sections.items():
        if not any(section_matches(section, node) for node in nodes):
            continue
        for name, value in values.items():
            earlier, kept = own.get(name, ("", value))
            if "*" in section and kept != value:
                raise ValueError(
                    f"parameter file {path}: {section} sets {name} to {value!r} after {earlier} set it to {kept!r}, "
                    f"and ROS takes the later value: put {section} before {earlier}"
                )
            if "*" not in section:
                own[name] = section, value


def section_matches(section: str, node: str) -> bool:
    """Whether a section is for a node, both fully qualified; ``*`` is one part of the name, ``**`` any number."""

    def match(pattern: list[str], parts: list[str]) -> bool:
        if not pattern:
            return not parts
        if pattern[0] == "**":
            return any(match(pattern[1:], parts[skipped:]) for skipped in range(len(parts) + 1))
        return bool(parts) and pattern[0] in ("*", parts[0]) and match(pattern[1:], parts[1:])

    return match(section.strip("/").split("/"), node.strip("/").split("/"))


def main() -> int:
    """Write the parameter files of ``config/`` in the current folder."""
    for node in SCHEMAS:
        entries = read_schema(Path("config") / f"{node}.schema.yaml")
        write_text(Path("config") / f"{node}.params.yaml", parameter_file_text(node, entries))
    return 0


if __name__ == "__main__":
    sys.exit(main())
