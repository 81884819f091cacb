"""Hidden faults: chosen by name or at random, and the ground-truth file that records them."""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from monoforce_ros.core import write_text
from monoforce_ros.synthetic import faults
from monoforce_ros.synthetic.fault import Fault
from monoforce_ros.synthetic.random_streams import random_stream


def _catalogue() -> dict[str, type[Fault]]:
    def snake(name: str) -> str:
        return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()

    kinds = [kind for _, kind in inspect.getmembers(faults, inspect.isclass) if issubclass(kind, Fault)]
    return {snake(kind.__name__): kind for kind in kinds if kind is not Fault}


FAULTS: dict[str, type[Fault]] = _catalogue()
"""Every fault by name, which is that of the catalogue's effect where there is one."""

# Probability of each kind of random world.
_KINDS = (("nothing", 0.2), ("single", 0.45), ("pair", 0.2), ("out_of_catalogue", 0.15))


def parse_hidden(text: str) -> Fault:
    """The fault of ``NAME``, ``NAME:VALUE`` or ``NAME:PARAMETER=VALUE,PARAMETER=VALUE``.

    Raises:
        ValueError: there is no fault of this name, no such parameter, or a value is out of range.
    """
    name, _, rest = text.partition(":")
    if name not in FAULTS:
        raise ValueError(f"--hide: got {name!r}, expected one of {', '.join(sorted(FAULTS))}")
    kind = FAULTS[name]
    names_some = "=" in rest
    values = {
        name: entry.neutral if names_some and entry.one_of_many else entry.default
        for name, entry in kind.parameters.items()
    }
    for number, part in enumerate(filter(None, rest.split(","))):
        parameter, equals, value = part.partition("=")
        if not equals:
            parameter, value = next(iter(values)), part
            if number:
                raise ValueError(f"--hide {text}: got {part!r}, expected PARAMETER=VALUE after the first comma")
        if parameter not in values:
            raise ValueError(f"--hide {text}: got parameter {parameter!r}, expected one of {', '.join(values)}")
        declared = kind.parameters[parameter]
        try:
            values[parameter] = float(value)
        except ValueError:
            raise ValueError(f"--hide {text}: got {value!r}, expected a number") from None
        if not (math.isfinite(values[parameter]) and declared.low <= values[parameter] <= declared.high):
            raise ValueError(
                f"--hide {text}: got {parameter} = {value}, expected {declared.low:g} to {declared.high:g}"
            )
    return kind(**values)


def draw_hidden(seed: int, excluded: Sequence[str] = ()) -> tuple[Fault, ...]:
    """Random faults: none, one, two of different names, or one that is not in the catalogue of effects.

    Faults of steering and flippers are never drawn, since most robots have neither.

    Parameters deviate from their neutral value by 0.6 to 1.4 times as much as the default does, within their range.

    Args:
        seed: seed of the random draw.
        excluded: names never drawn, such as ``vegetation_drag`` in a world without vegetation.
    """
    random = random_stream(seed, "hidden")
    kind = str(random.choice([name for name, _ in _KINDS], p=[probability for _, probability in _KINDS]))
    count = {"nothing": 0, "pair": 2}.get(kind, 1)
    in_catalogue = kind != "out_of_catalogue"
    names = [
        name
        for name, fault in sorted(FAULTS.items())
        if fault.in_catalogue == in_catalogue and not fault.needs and name not in excluded
    ]
    drawn = []
    for name in random.choice(names, count, replace=False):
        values = {}
        for parameter, declared in FAULTS[name].parameters.items():
            is_symmetric = declared.low == -declared.high
            sign = random.choice([-1.0, 1.0]) if is_symmetric else 1.0
            deviation = sign * (declared.default - declared.neutral) * random.uniform(0.6, 1.4)
            values[parameter] = float(np.clip(declared.neutral + deviation, declared.low, declared.high))
        drawn.append(FAULTS[name](**values))
    return tuple(drawn)


def describe(hidden: Sequence[Fault]) -> list[dict]:
    """Name and parameters of each fault, and whether it is in the catalogue of effects."""
    names = {kind: name for name, kind in FAULTS.items()}
    return [
        {
            "name": names[type(fault)],
            "parameters": fault.values,
            "in_catalogue": fault.in_catalogue,
        }
        for fault in hidden
    ]


def truth_file(bag: Path) -> Path:
    """Path of a bag's ground-truth file, next to the bag."""
    return bag.with_name(f"{bag.name}.hidden.json")


def write_truth(bag: Path, hidden: Sequence[Fault], seed: int) -> Path:
    """Write the faults hidden in a bag to its ground-truth file, atomically; returns the file."""
    target = truth_file(bag)
    write_text(target, json.dumps({"hidden": describe(hidden), "seed": seed}, indent=2) + "\n")
    return target
