"""The rooms' order in docs/architecture.md is the order that the imports follow."""

import ast
import re
from pathlib import Path

import pytest
from conftest import ROOT

from monoforce_ros.effects import CATALOGUE

PACKAGE = ROOT / "monoforce_ros"
PAGE = ROOT / "docs" / "architecture.md"
FILES = sorted(PACKAGE.rglob("*.py"))


def rooms() -> list[str]:
    """Rooms in the order of the page's table, from the ground up."""
    return re.findall(r"^\| \[`(\w+)/`\]\(\.\./monoforce_ros/\w+\) \|", PAGE.read_text(), re.MULTILINE)


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path) -> list[tuple[str, str]]:
    """Module and name of every import from the package, wherever it stands in the file."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import hides where it leads"
            if (node.module or "").split(".")[0] == "monoforce_ros":
                found += [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names if alias.name.split(".")[0] == "monoforce_ros"]
    return found


def exported(room: str) -> set[str]:
    tree = ast.parse((PACKAGE / room / "__init__.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def test_every_room_is_on_the_page_and_every_room_of_the_page_is_there():
    folders = [p.name for p in PACKAGE.iterdir() if (p / "__init__.py").is_file()]
    assert sorted(rooms()) == sorted(folders)
    assert len(rooms()) == len(set(rooms())) > 10


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_imports_only_public_names_of_rooms_above_its_own(path):
    order, own = rooms(), room_of(path)
    for module, name in imports(path):
        parts = module.split(".")
        room = parts[1] if len(parts) > 1 else name
        if not own or room == own:
            continue
        assert order.index(room) < order.index(own), f"{own}/ imports {room}/, which stands below it in {PAGE.name}"
        assert len(parts) == 2 and name, f"{module}: import public names from monoforce_ros.{room}"
        assert name in exported(room), f"{name} is not exported by monoforce_ros.{room}"
        assert not name.startswith("_"), f"{module}.{name} is private"


def test_scripts_and_benchmarks_import_names_that_are_there():
    files = [path for folder in ("scripts", "benchmarks") for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(files) > 20
    for path in files:
        for module, name in imports(path):
            parts = module.split(".")
            if len(parts) == 2 and exported(parts[1]) and not (PACKAGE / parts[1] / f"{name}.py").is_file():
                assert name in exported(parts[1]), f"{path}: {name} is not exported by {module}"


def test_mujoco_is_imported_where_its_graphics_library_is_chosen():
    """It selects one when it is first imported: any other file may come first, and then nothing can be drawn."""
    folders = ("monoforce_ros", "benchmarks", "scripts", "test")
    direct = {
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"^\s*(import|from) mujoco\b", path.read_text(), re.MULTILINE)
    }
    assert direct == {"monoforce_ros/synthetic/graphics.py"}


def test_no_modules_import_each_other_in_a_circle():
    known = {module_of(path) for path in FILES}
    graph: dict[str, set[str]] = {}
    for path in FILES:
        targets = set()
        for module, name in imports(path):
            inner = f"{module}.{name}"
            targets.add(inner if inner in known else module)
        graph[module_of(path)] = targets - {module_of(path)}
    done: set[str] = set()
    open_modules: list[str] = []

    def visit(module: str) -> None:
        if module in done or module not in graph:
            return
        if module in open_modules:
            circle = [*open_modules[open_modules.index(module) :], module]
            pytest.fail(f"modules import each other: {' -> '.join(circle)}")
        open_modules.append(module)
        for target in sorted(graph[module]):
            visit(target)
        open_modules.pop()
        done.add(module)

    for module in sorted(graph):
        visit(module)


def test_numbers_of_a_diagnosis_say_where_they_come_from():
    """Every number that stands by itself in a module of ``discrepancy`` has a sentence below it."""
    silent = []
    for path in sorted((PACKAGE / "discrepancy").glob("*.py")):
        body = ast.parse(path.read_text(), filename=str(path)).body
        for node, below in zip(body, [*body[1:], None], strict=True):
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
            names = [part.id for target in targets if target for part in ast.walk(target) if isinstance(part, ast.Name)]
            if value is None or isinstance(value, ast.Dict) or not names or not names[0].isupper():
                continue
            numbers = [part.value for part in ast.walk(value) if isinstance(part, ast.Constant)]
            if not any(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers):
                continue
            text = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else None
            if not isinstance(text, str):
                silent.append(f"{path.name}:{node.lineno} {', '.join(names)}")
    assert not silent, f"{silent}: expected a docstring that says where the number comes from"


_TRANSLATIONS = ("discrepancy/mujoco_export.py", "discrepancy/ros_export.py")
"""Files that write effects in the words of other tools, which have a place for some of them."""


def test_no_rule_names_an_effect_outside_its_own_file():
    """What is particular to an effect is a property of it; the synthetic worlds plant effects by name."""
    named = {}
    for path in sorted((ROOT / "monoforce_ros").rglob("*.py")):
        inside = path.relative_to(ROOT / "monoforce_ros").as_posix()
        if inside.startswith(("effects/", "synthetic/")) or inside in _TRANSLATIONS or path.name == "__init__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and node.value in CATALOGUE:
                named.setdefault(inside, []).append((node.lineno, node.value))
    assert not named, f"effects are named by hand: {named}"
