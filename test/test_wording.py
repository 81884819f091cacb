"""What users read says things the way the field does: no phrases that roboticists stumble over."""

import re

import pytest
from conftest import ROOT

# Phrase to avoid: what to write.
PHRASES = {
    "told apart by": "detected automatically",
    "stands on `/diagnostics`": "reported on `/diagnostics`",
    "way of driving in which": "motion regime with",
    "how much of the way to the goal": "remaining path length to the goal",
    "why it stands": "the reason for stopping",
    "how far they give way": "predicted compliance",
    "as its base would": "zero velocity is assumed",
    "ensemble step back": "niceness of the background thread",
    "fitted anew": "leave-one-out",
    "go unsaid": "not reported",
    "an image tells to": "uncertain by … in an image",
    "say something on their own": "independent",
    "began anew": "after a backward time jump",
    "as little as today": "makes no progress",
    "which go before the arguments": "overrides launch arguments",
    "send nothing": "no messages",
    "odometry: fresh": "receiving odometry",
    "taken as the same place": "the offset is ignored",
    "age in set": "age relative to the newest sensor",
    "of which noise": "noise floor",
    "times its weight lies there": "the cost term equals its weight",
    "begin so long after": "delay until a candidate takes effect",
    "the robot is told": "commanded",
    "that the catalogue does not hold": "no known effect fits",
    "come to grief": "tipped over or left the map",
    "leads nowhere": "makes no progress",
}
FOLDERS = ("config", "docs", "launch", "monoforce_ros", "scripts")
FILES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".md", ".py", ".yaml")
    ),
]


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_phrase_is_not_used(phrase):
    assert len(FILES) > 100
    # Phrases may be broken over lines, also of a Python string or comment.
    pattern = re.compile(r"[\s\"'#]+".join(map(re.escape, phrase.split())), re.IGNORECASE)
    found = [str(path.relative_to(ROOT)) for path in FILES if pattern.search(path.read_text(encoding="utf-8"))]
    assert not found, f"write {PHRASES[phrase]!r} in place of {phrase!r}"
