"""Hidden: which physics is injected in a world, by name or by lot, and the file that keeps the truth."""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

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
"""Everything that can be hidden, by name: that of the catalogue's effect where it has one."""

# Chances of a drawn world: nothing hidden, one effect, two, one that the catalogue does not hold.
_KINDS = (("nothing", 0.2), ("single", 0.45), ("pair", 0.2), ("outsider", 0.15))


def parse_hidden(text: str) -> Fault:
    """The fault of ``NAME``, ``NAME:VALUE`` or ``NAME:PARAMETER=VALUE,PARAMETER=VALUE``.

    Raises:
        ValueError: there is none of that name, no such parameter, or a value is out of range.
    """
    name, _, rest = text.partition(":")
    if name not in FAULTS:
        raise ValueError(f"--hide: got {name!r}, expected one of {', '.join(sorted(FAULTS))}")
    kind = FAULTS[name]
    values = {parameter: default for parameter, (default, _, _) in kind.parameters.items()}
    for number, part in enumerate(filter(None, rest.split(","))):
        parameter, equals, value = part.partition("=")
        if not equals:
            parameter, value = next(iter(values)), part
            if number:
                raise ValueError(f"--hide {text}: got {part!r}, expected PARAMETER=VALUE after the first comma")
        if parameter not in values:
            raise ValueError(f"--hide {text}: got parameter {parameter!r}, expected one of {', '.join(values)}")
        low, high = kind.parameters[parameter][1:]
        try:
            values[parameter] = float(value)
        except ValueError:
            raise ValueError(f"--hide {text}: got {value!r}, expected a number") from None
        if not (math.isfinite(values[parameter]) and low <= values[parameter] <= high):
            raise ValueError(f"--hide {text}: got {parameter} = {value}, expected {low:g} to {high:g}")
    return kind(**values)


def draw_hidden(seed: int, without: Sequence[str] = ()) -> tuple[Fault, ...]:
    """Hidden effects by lot: none, one, two of different names, or one that is not in the catalogue.

    Values are spread over the middle of their range about the default.

    Args:
        seed: decides all.
        without: names never drawn, such as ``vegetation_drag`` in a world without vegetation.
    """
    random = random_stream(seed, "hidden")
    kind = random.choice([name for name, _ in _KINDS], p=[chance for _, chance in _KINDS])
    count = {"nothing": 0, "pair": 2}.get(kind, 1)
    names = [n for n, p in sorted(FAULTS.items()) if p.in_catalogue == (kind != "outsider") and n not in without]
    drawn = []
    for name in random.choice(names, count, replace=False):
        values = {}
        for parameter, (default, low, high) in FAULTS[name].parameters.items():
            sign = random.choice([-1.0, 1.0]) if low < 0.0 < high and low == -high else 1.0
            # Parameters that mean nothing at 1 keep their distance from it, the others from 0.
            neutral = 1.0 if parameter in ("gain", "factor", "wheelbase_factor", "strength") else 0.0
            value = neutral + sign * (default - neutral) * random.uniform(0.6, 1.4)
            values[parameter] = float(min(max(value, low), high))
        drawn.append(FAULTS[name](**values))
    return tuple(drawn)


def describe(hidden: Sequence[Fault]) -> list[dict]:
    """Name, parameters and whether the catalogue holds it, of each fault."""
    names = {kind: name for name, kind in FAULTS.items()}
    return [
        {
            "name": names[type(fault)],
            "parameters": {parameter: getattr(fault, parameter) for parameter in fault.parameters},
            "in_catalogue": fault.in_catalogue,
        }
        for fault in hidden
    ]


def truth_file(bag: Path) -> Path:
    """Where the truth of a bag lies: beside it, never in it."""
    return bag.with_name(f"{bag.name}.hidden.json")


def write_truth(bag: Path, hidden: Sequence[Fault], seed: int) -> Path:
    """Write what is hidden in a bag beside it; returns the file, which appears only when it is complete."""
    target = truth_file(bag)
    write_text(target, json.dumps({"hidden": describe(hidden), "seed": seed}, indent=2) + "\n")
    return target
