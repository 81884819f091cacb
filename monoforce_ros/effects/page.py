"""Generates docs/effects.md, the page that lists all effects, from the catalogue."""

from __future__ import annotations

from monoforce_ros.effects.catalogue import CATALOGUE, speed_effects
from monoforce_ros.effects.effect import REFERENCE_MASS, STAGES

_INTRODUCTION = """# Effects

Use this page to describe your robot beyond plain mechanics: look up an effect, its parameters and their units, and add
it to the robot's file. `diagnose` identifies most of them in recordings and adds them to the file.

An effect is an optional, named physical effect. At its neutral values the prediction is unchanged, bit for bit:

```yaml
effects:
  - name: actuator_lag
    parameters:
      time_constant: {value: 0.31, low: 0.27, high: 0.36, unit: s}   # or just: time_constant: 0.31
    provenance: {bag: yard.mcap, date: 2026-11-02}
```

Effects can be combined. Effects on commands act in this order: {order}.
Limits of the twist act before it becomes drive speeds.
Delay and lag use the commands from before the start. Contact and body effects act in the rollout, in both backends, and
every parameter is differentiable. Measurement effects change recorded data, not the motion itself.

Typical forces and loads "of 50 kg" are those of such a robot; on others they are as much of its mass.

This page is generated: `python -m monoforce_ros.effects.page > docs/effects.md`.
"""


def catalogue_page() -> str:
    """Markdown of all effects with formula, parameters, bounds and source."""
    parts = [_INTRODUCTION.replace("{order}", ", ".join(f"`{effect.name}`" for effect in speed_effects()))]
    for stage in STAGES:
        parts.append(f"## {stage.capitalize()}\n")
        for effect in CATALOGUE.values():
            if effect.stage != stage:
                continue
            parts.append(f"### {effect.name}\n\n{effect.summary}\n\n`{effect.formula}` — {effect.source}\n")
            rows = ["| parameter | unit | neutral | bounds | typical | meaning |", "|---|---|---|---|---|---|"]
            listed = effect.parameters if len(effect.parameters) < 8 else effect.parameters[:3]
            rows += [
                f"| `{p.name}` | {p.unit} | {p.neutral:g} | {p.low:g} … {p.high:g} | ± {p.scale:g}"
                f"{f' of {REFERENCE_MASS:g} kg' if p.of_mass else ''} | {p.meaning} |"
                for p in listed
            ]
            rows = [row.replace("vx|vx|", "vx\\|vx\\|") for row in rows]
            if len(listed) < len(effect.parameters):
                names = ", ".join(f"`{p.name}`" for p in effect.parameters[len(listed) :])
                rows.append(f"\nLikewise: {names}")
            if effect.manoeuvre:
                rows.append(f"\nObservable in: {effect.manoeuvre}.")
            parts.append("\n".join(rows) + "\n")
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    print(catalogue_page(), end="")
