"""How the package is built: who imports whom, what importing it costs, and what every file promises.

A module imports only from the floors below its own and from its own package, so that any floor can be read, tested and
replaced without those above it; the two lowest need neither torch nor numpy, because their numbers may be of any kind.
"""

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
import tomllib
from functools import cache

import pytest
from concerned import holding
from helpers import all_in_one
from places import ENVS, PACKAGE, ROOT, TESTS

import torchdq
from torchdq import functional
from torchdq.effects.effect import Effect


def rows(package, text):
    """Row of every module and package within a package, from the lowest; "." is the package itself."""
    return {f"{package}.{name}".rstrip("."): k for k, row in enumerate(text.split("|")) for name in row.split()}


FLOORS = rows(
    "torchdq",
    """findings | errors | base algebra numbers | dynamics program | backends | export dq | convert robot | functions
    | objects | control effects | functional closures task_space pose_solver functions.compile | floating scene paper
    | layers | layers.residual recommend optimal | nn envs | learning | . | command | __main__""",
)
# storeys of the packages that have several: files that a row does not name are on the first
STOREYS = {
    **rows(
        "torchdq.robot",
        """check.consistency description | fields | model | tree bodies contact_points | check | edit | assembly
        | from_dh from_screws urdf mjcf | robot | argument . | shipped""",
    ),
    # parts of a step, the frozen model, many steps, Scene
    **rows("torchdq.scene", "| model | loops describe linearize | rollout | stability | scene | defaults ."),
    **rows(
        "torchdq.learning",
        """| logs excitation.limits | evaluation | identification fit rollout | bodies evaluate
        | plots | excitation | .""",
    ),
    **rows("torchdq.optimal", "| knot | riccati | problem | sampling | ilqr | derivatives exported | receding | ."),
    # outcomes, options that commands share, the commands, the command line
    **rows("torchdq.command", "|| command | report bench identify scene accuracy export view cost doctor | main | ."),
}

NUMBER_GENERIC = ("torchdq.algebra", "torchdq.dynamics", "torchdq.numbers")
NOT_AT_IMPORT = (
    *("pinocchio", "pytorch_kinematics", "mujoco", "matplotlib", "scipy", "gymnasium", "tyro", "rich"),
    "torchdq.paper",
    *("sympy", "torch._dynamo"),  # torch imports them in more than a second, on first use of its compiler
)


def name_of(path):
    """Dotted name of a module's file; `envs` is installed as a part of the package."""
    parts = ("torchdq", *path.relative_to(PACKAGE if path.is_relative_to(PACKAGE) else ROOT).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


FILES = {name_of(path): path for folder in (PACKAGE, ENVS) for path in sorted(folder.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in FILES.items()}
MODULES = all_in_one(FILES)


def within(module, package):
    return module == package or module.startswith(package + ".")


def longest(module, table):
    """Entry of the table for the innermost package that the module is in; the top-level one is for itself only."""
    known = [name for name in table if module == name or (within(module, name) and name != "torchdq")]
    return table[max(known, key=len)] if known else None


def statements_at_run_time(node):
    """All statements below, but for what only a type checker sees."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            continue
        if isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            continue
        yield child
        yield from statements_at_run_time(child)


def imports_of(tree):
    """Dotted names of the modules that a tree imports, wherever in it."""
    for node in statements_at_run_time(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"line {node.lineno}: imports name the whole path"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in FILES else node.module


@cache
def imported(module):
    """Dotted names of the modules that a module of the package imports."""
    return [*imports_of(TREES[module])]


def placed(module):
    """Entry of the table of storeys for a module, and its number; those of no entry are on the lowest."""
    known = [name for name in STOREYS if module == name or (within(module, name) and name not in FLOORS)]
    entry = max(known, key=len, default=None)
    return entry, STOREYS.get(entry, 0)


def may_import(module, other):
    """Whether a module of the package may import another."""
    ours, theirs = longest(module, FLOORS), longest(other, FLOORS)
    if theirs != ours:
        return theirs < ours
    package = next(name for name, floor in FLOORS.items() if floor == ours and within(module, name))
    if not within(other, package):
        return False  # a floor's packages do not know each other
    (here, storey), (there, lower) = placed(module), placed(other)
    return lower < storey or here == there


# --- floors ----------------------------------------------------------------------------------------------------------


@MODULES
def test_every_module_has_a_floor(module):
    assert longest(module, FLOORS) is not None


@MODULES
def test_a_module_imports_from_lower_floors_or_its_own_package(module):
    inside = [other for other in imported(module) if within(other, "torchdq")]
    assert [other for other in inside if not may_import(module, other)] == []


def test_the_rule_forbids_what_it_is_for():
    for module, other in (
        ("torchdq.dynamics.general.rnea", "torchdq.robot.robot"),
        ("torchdq.robot.robot", "torchdq.convert"),
        ("torchdq.robot.edit.reduced", "torchdq.robot.robot"),
        ("torchdq.scene.rollout", "torchdq.scene.scene"),
        ("torchdq.functional", "torchdq"),
    ):
        assert not may_import(module, other), module


@all_in_one([name for name in FILES if any(within(name, package) for package in NUMBER_GENERIC)])
def test_the_lowest_floors_import_only_each_other_and_errors(module):
    known = (*NUMBER_GENERIC, "torchdq.errors", *sys.stdlib_module_names)
    assert [x for x in imported(module) if not any(within(x, package) for package in known)] == []


def test_importing_the_package_imports_nothing_heavy_but_torch_and_its_subpackages_on_first_use():
    """And an attribute that is misspelt has one hint, to which Python adds no second."""
    program = "import sys, torchdq; print(*sys.modules)"
    program += "; torchdq.Scene, torchdq.recommend_settings; assert 'gymnasium' not in sys.modules"
    program += "; assert 'TorchTask' in dir(torchdq.envs); assert 'identify' in dir(torchdq.learning); torchdq.DQRNAE"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    loaded = run.stdout.split()
    assert "torch" in loaded
    assert sorted(set(NOT_AT_IMPORT) & set(loaded)) == []
    assert "AttributeError" in run.stderr and run.stderr.count("DQRNEA") == 1


# --- what a file promises --------------------------------------------------------------------------------------------

EVERYWHERE = {
    str(path.relative_to(ROOT)): path
    for folder in ("torchdq", "envs", "tests", "examples", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


@all_in_one(EVERYWHERE)
def test_every_file_says_what_it_is(file):
    lines = EVERYWHERE[file].read_text(encoding="utf-8").splitlines()
    first = next(k for k, line in enumerate(lines) if line and line[0] != "#")  # after a line for the shell
    assert re.match('r?"""[^"]', lines[first])


def public(tree):
    """Public functions and classes of a module, and the public methods of the latter, by name."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, node
            if isinstance(node, ast.ClassDef):
                yield from ((f"{node.name}.{name}", method) for name, method in public(node))


@MODULES
def test_everything_public_has_a_docstring(module):
    assert [name for name, node in public(TREES[module]) if not ast.get_docstring(node)] == []


ON_ROBOTS = [
    name
    for name, f in inspect.getmembers(functional, inspect.isfunction)
    if f.__module__ == functional.__name__ and "q" in inspect.signature(f).parameters and not name.startswith("_")
]


@pytest.mark.parametrize("name", ON_ROBOTS)
def test_a_function_on_robots_states_units_and_first_of_all_the_shape_of_its_result(name):
    document = getattr(functional, name).__doc__
    assert re.search(r"\[(rad|m|kg|N|J)\b", document)
    assert "[..." in document.split("\n\n")[0] and "shape [..., n]" in document.split("Args:")[1]


@MODULES
def test_every_name_that_is_offered_exists(module):
    offered = getattr(importlib.import_module(module), "__all__", ())
    assert len(set(offered)) == len(offered)
    assert [name for name in offered if not hasattr(importlib.import_module(module), name)] == []


def test_the_package_offers_all_its_errors():
    errors = {
        name
        for name, value in vars(importlib.import_module("torchdq.errors")).items()
        if isinstance(value, type) and issubclass(value, Exception)
    }
    assert errors - set(dir(torchdq)) == set()


def test_nothing_is_printed_and_input_is_checked_by_errors_not_by_assert():
    calls = [(module, node) for module, node in nodes_of(ast.Call) if getattr(node.func, "id", "") == "print"]
    found = [at(*place) for place in (*calls, *nodes_of(ast.Assert))]  # python -O leaves assertions out
    assert not found, listed(found)


def test_nothing_is_named_after_what_it_is_not():
    vague = re.compile(r"util|helper|misc", re.IGNORECASE)
    names = [part for module in FILES for part in module.split(".")]
    names += [name for tree in TREES.values() for name, _ in public(tree)]
    assert [name for name in names if vague.search(name)] == []


# --- rules of the house ----------------------------------------------------------------------------------------------

ALLOWED = tomllib.loads((TESTS / "claims" / "allowances.toml").read_text(encoding="utf-8"))  # with the reasons
LONGEST, MOST_ARGUMENTS = 60, 8  # lines of code of a function, and its arguments
JOINT_KINDS = {"revolute", "prismatic", "helical", "fixed", "free"}
DEFAULTS = ".defaults"  # modules of this name build the effects that there are by default
DEPENDENCIES = {"torch", "numpy", "gymnasium", "rich", "tyro"}
OPTIONAL = "torchdq.base.optional"


def at(module, node):
    """Place of a node in the sources."""
    return f"{FILES[module].relative_to(ROOT)}:{node.lineno}"


def listed(found):
    """A line for everything found, so that none is hidden in the message of a test."""
    return "\n" + "\n".join(str(x) for x in found)


@cache
def nodes():
    """All nodes of all modules, with the module."""
    return [(module, node) for module, tree in TREES.items() for node in ast.walk(tree)]


def nodes_of(kind):
    """Nodes of a kind, with the module."""
    return [(module, node) for module, node in nodes() if isinstance(node, kind)]


def functions(tree, path):
    """Functions of a module with their qualified names."""
    for node in ast.iter_child_nodes(tree):
        name = f"{path}.{node.name}" if hasattr(node, "name") and not isinstance(node, ast.alias) else path
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield name, node
        if not isinstance(node, ast.expr):
            yield from functions(node, name)


def lines_of_code(function):
    """Lines of a function from its first statement that is no docstring."""
    body = function.body[1:] if ast.get_docstring(function, clean=False) else function.body
    return function.end_lineno - body[0].lineno + 1 if body else 0


def arguments_of(function):
    """Number of arguments, the object itself not counted."""
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    return sum(x.arg not in ("self", "cls") for x in named)


def test_functions_are_short_and_have_few_arguments():
    """But for those that say why not; those that are short by now are taken from the list."""
    found = {
        name: f"{lines_of_code(node)} lines of code, {arguments_of(node)} arguments"
        for module, tree in TREES.items()
        for name, node in functions(tree, module)
        if lines_of_code(node) > LONGEST or arguments_of(node) > MOST_ARGUMENTS
    }
    excused = ALLOWED["long"]
    assert found.keys() == excused.keys(), listed(sorted((x, found.get(x)) for x in found.keys() ^ excused.keys()))


def inner_folder(module):
    """Folder of a module below the room that it is in; None: there is none."""
    parts = module.split(".")
    parts = parts if FILES[module].name == "__init__.py" else parts[:-1]
    return ".".join(parts[:3]) if len(parts) > 2 else None


def test_folders_within_a_room_form_no_circle():
    """Rooms themselves do not, by their floors."""
    known = {}
    for module in TREES:
        here = inner_folder(module)
        there = {inner_folder(other) for other in imported(module) if other in FILES}
        known.setdefault(here, set()).update(x for x in there if here and x and x.split(".")[1] == here.split(".")[1])
    reached = {folder: set(others) for folder, others in known.items()}
    for _ in known:
        for others in reached.values():
            others.update(*(reached.get(other, ()) for other in tuple(others)))
    pairs = {", ".join(sorted((a, b))) for a in reached for b in reached[a] if a != b and a in reached.get(b, ())}
    assert not pairs, listed(pairs)


def test_only_readers_of_descriptions_know_the_words_for_joints():
    """No module outside the readers of descriptions compares names of joint types; it asks the joint object."""
    words = [
        (module, node, {x.value for x in ast.walk(node) if isinstance(x, ast.Constant) and isinstance(x.value, str)})
        for module, node in nodes_of((ast.Compare, ast.MatchValue))
        if not within(module, "torchdq.robot")
    ]
    found = [(at(module, node), *sorted(said & JOINT_KINDS)) for module, node, said in words if said & JOINT_KINDS]
    assert not found, listed(found)


def subclasses(kind):
    """Modules of the package's classes made from one, directly or not, by name."""
    found = {x.__name__: x.__module__ for x in kind.__subclasses__() if x.__module__ in FILES}
    return found | {name: module for x in kind.__subclasses__() for name, module in subclasses(x).items()}


def types_asked(node):
    """Names of the types that a call, a comparison or a pattern tells values apart by."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass"):
        asked = node.args[1:]
    elif isinstance(node, ast.Compare) and any(isinstance(op, ast.Is | ast.IsNot) for op in node.ops):
        asked = [node.left, *node.comparators]
    elif isinstance(node, ast.MatchClass):
        asked = [node.cls]
    else:
        return set()
    inner = [x for outer in asked for x in ast.walk(outer)]
    return {x.id for x in inner if isinstance(x, ast.Name)} | {x.attr for x in inner if isinstance(x, ast.Attribute)}


def test_no_effect_is_known_by_name_but_in_its_own_file():
    for module in FILES:
        importlib.import_module(module)
    effects = subclasses(Effect)
    assert {"Gravity", "RotorInertia", "Viscous", "Elastic"} <= set(effects)
    found = [
        (at(module, node), name)
        for module, node in nodes_of((ast.Call, ast.Compare, ast.MatchClass))
        for name in sorted(types_asked(node) & set(effects))
        if effects[name] != module and not module.endswith(DEFAULTS)
    ]
    assert not found, listed(found)


def test_what_may_not_be_installed_is_imported_in_one_place():
    known = {*sys.stdlib_module_names, *DEPENDENCIES, "torchdq"}
    imports = [
        (module, name)
        for module in FILES
        if module != OPTIONAL
        for name in imported(module)
        if name.partition(".")[0] not in known
    ]
    caught = [
        at(module, node)
        for module, node in nodes_of(ast.ExceptHandler)
        if module != OPTIONAL and node.type and re.search("ImportError|ModuleNotFound", ast.unparse(node.type))
    ]
    named = [
        at(module, node)
        for module, node in nodes_of(ast.Call)
        if module != OPTIONAL and "import_module" in (getattr(node.func, "attr", ""), getattr(node.func, "id", ""))
    ]
    found = [*imports, *caught, *named]
    assert not found, listed(found)


# --- tests -----------------------------------------------------------------------------------------------------------

TEST_TREES = {
    path.relative_to(TESTS).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(TESTS.rglob("*.py"))
}


def test_every_module_has_its_tests():
    """In the file of its name, in those that notice faults planted in it, or in the one that is said to hold it."""
    said = {module for modules in ALLOWED["held"].values() for module in modules.split()}
    found = [m for m, path in FILES.items() if path.name not in ("__init__.py", "__main__.py") and not holding(path)]
    assert not found, listed(found)
    gone = [module for module in said if f"torchdq.{module}" not in FILES]
    gone += [file for file in ALLOWED["held"] if not (TESTS / file).exists()]
    assert not gone, listed(gone)


def test_tests_import_no_tests():
    found = [
        (file, node.lineno)
        for file, tree in TEST_TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (getattr(node, "module", "") or "", *(alias.name for alias in node.names))
        if name.rpartition(".")[2].startswith("test_") or name == "conftest"
    ]
    assert not found, listed(found)


def private_reads(tree):
    """Places where a private attribute of something else is read, or replaced by name."""
    own = {"self", "cls", "torch", "_ctypes", "os", "atexit", "forkserver", "Tensor", "func"}
    documented = {"_replace", "_asdict", "_fields", "_make", "_version"}  # of named tuples and tensors
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr) and node.attr not in documented:
            root = node.value
            while isinstance(root, ast.Attribute):
                root = root.value
            if getattr(root, "id", "") not in own:
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "setattr":
            call = ast.unparse(node)
            if re.match(r"\w*patch\.setattr\(\w+, '_[a-z]", call):
                yield node.lineno, call


def test_tests_read_few_private_attributes():
    found = [(file, *place) for file, tree in TEST_TREES.items() for place in private_reads(tree)]
    allowed = ALLOWED["private_reads"]
    assert len(found) <= allowed, listed([f"{len(found)} of at most {allowed}", *found])


# --- what is installed -----------------------------------------------------------------------------------------------

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_package_is_installed():
    packages = {name for name, path in FILES.items() if path.name == "__init__.py"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == packages
    assert {path.parent / "__init__.py" for path in FILES.values()} <= set(FILES.values())


def checked(*command):
    """Output of a checker on the project; empty when it has nothing to say."""
    environment = os.environ | {"NO_COLOR": "1"}
    run = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, env=environment)
    return "" if run.returncode == 0 else run.stdout + run.stderr


def test_ruff_has_nothing_to_say():
    pytest.importorskip("ruff")
    assert checked("ruff", "check", "--no-cache") == ""
    assert checked("ruff", "format", "--check", "--no-cache") == ""


def test_help_of_the_package_names_everything():
    missing = [name for name in torchdq.__all__ if not name.endswith("Error") and name not in torchdq.__doc__]
    assert missing == []
    assert {*dir(torchdq)} == {*torchdq.__all__, "__version__"}
