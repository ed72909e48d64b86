"""The public faces: modules that CHANGELOG lists, signatures as in the catalogue, names that docs and examples use."""

import ast
import importlib
import inspect
import re

import pytest
from helpers import all_in_one
from places import ROOT

import torchdq
from torchdq import floating, functional, task_space
from torchdq.export.meaning import WORDS
from torchdq.functions.catalogue import FLOATING, RECIPES

# arguments that are no tensors
OTHERS = {"robot", "backend", "precision", "frame", "expressed", "axes", "limits", "coriolis"}
OTHERS |= {"points", "objects", "own", "of"}
FUNCTIONS = {
    **{name: getattr(functional, name) for name in RECIPES if hasattr(functional, name)},
    **{name: getattr(task_space, name) for name in RECIPES if hasattr(task_space, name)},
    "differential_inverse_kinematics": torchdq.differential_inverse_kinematics,
    **{FLOATING + name: getattr(floating, name) for name in floating.__all__ if name.islower()},
}


@pytest.mark.parametrize("face", [functional, floating, task_space, torchdq.nn], ids=lambda x: x.__name__)
def test_a_face_holds_nothing_but_signatures_and_documentation(face):
    own = {name: x for name, x in vars(face).items() if getattr(x, "__module__", None) == face.__name__}
    results = {name for name, x in own.items() if inspect.isclass(x) and issubclass(x, tuple)}
    assert own.keys() - results <= set(face.__all__)


# --- what is public --------------------------------------------------------------------------------------------------

PUBLIC = set(re.findall(r"`(torchdq[\w.]*)`", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("## ")[0]))
# modules whose `__all__` others export: they are no doors
INNER = {
    "torchdq.closures",
    "torchdq.control",
    "torchdq.functional",
    "torchdq.pose_solver",
    "torchdq.recommend",
    "torchdq.task_space",
}
INNER |= {"torchdq.robot.shipped", "torchdq.robot.shipped.go2"}
MOST = 256  # distinct public names


def with_names():
    """Modules of the package that state their names."""
    for folder, package in ((ROOT / "torchdq", "torchdq"), (ROOT / "envs", "torchdq.envs")):
        for path in folder.rglob("*.py"):
            if re.search("^__all__ = ", path.read_text(encoding="utf-8"), re.MULTILINE):
                parts = path.relative_to(folder).with_suffix("").parts
                yield ".".join((package, *(part for part in parts if part != "__init__")))


def test_every_module_that_states_its_names_is_listed_as_public_or_known_as_an_inner_one():
    assert {*with_names(), "torchdq.robots"} == PUBLIC | INNER


def test_there_are_few_public_names():
    names = [name for module in PUBLIC for name in opened(module).__all__]
    assert len(set(names)) <= MOST


def test_modules_are_reached_after_importing_the_package_and_one_door_leads_to_each():
    for module in ("dq", "effects", "nn", "optimal", "scene", "envs", "learning"):
        assert opened(f"torchdq.{module}") is getattr(torchdq, module) and module in dir(torchdq)
    doors = {}
    for module in sorted(PUBLIC - {"torchdq", "torchdq.nn"}):  # torchdq has the layers and functions of everyday use
        for name in opened(module).__all__:
            doors.setdefault(id(getattr(opened(module), name)), []).append(f"{module}.{name}")
    assert [x for x in doors.values() if len(x) > 1] == []


def test_a_name_means_one_thing_but_for_laws_and_their_layers_and_functions_of_both_bases():
    meanings = {}
    for module in PUBLIC - {"torchdq.floating"}:
        for name in opened(module).__all__:
            meanings.setdefault(name, set()).add(id(getattr(opened(module), name)))
    laws = {"CartesianImpedance", "ComputedTorque", "OperationalSpaceControl"}
    others = {"Push"}  # a wrench and a task
    others |= {"Pose", "JointLimits"}  # and costs of them
    assert {name for name, of in meanings.items() if len(of) > 1} == laws | others


def opened(module):
    """Module of a dotted path below the package."""
    try:
        return importlib.import_module(module)
    except ImportError:  # another name, as `robots`
        package, _, name = module.rpartition(".")
        return getattr(importlib.import_module(package), name)


# --- one table for both faces ----------------------------------------------------------------------------------------


def test_every_function_of_the_catalogue_is_in_a_face():
    # parts of others, to be compiled
    programs_only = {"inverse_dynamics_jacobian", "inverse_kinematics_step", "inverse_kinematics_newton"}
    programs_only |= {
        "forward_dynamics_hessian",
        "joint_momentum",
        "contact_force",
        "closure_gaps",
        "loop_step",
        "loop_torques",
    }
    assert set(FUNCTIONS) == set(RECIPES) - programs_only


@all_in_one(FUNCTIONS)
def test_a_signature_is_that_of_the_catalogue(key):
    parameters = dict(inspect.signature(FUNCTIONS[key]).parameters)
    assert next(iter(parameters)) == "robot" and parameters["backend"].default is None
    tensors = {name: x for name, x in parameters.items() if name not in OTHERS}
    fields = [field for field in RECIPES[key].arguments if field.name != "sizes"]  # which objects have
    assert list(tensors) == [field.name for field in fields]
    required = [k for k, field in enumerate(fields) if not field.optional]
    for k, field in enumerate(fields):
        given = tensors[field.name]
        assert ("None" in str(given.annotation)) == field.optional
        # an argument that may be None has that default, unless one that must be given follows
        assert (given.default is None) == (field.optional and k > max(required))


@all_in_one([key for key in FUNCTIONS if FLOATING + key in FUNCTIONS])
def test_a_free_base_adds_an_argument_before_that_of_the_joints(name):
    before = {"X_WB": "q", "V_WB_B": "qd", "A_WB_B": "qdd", "f_base": None}
    fixed, free = (list(inspect.signature(FUNCTIONS[key]).parameters) for key in (name, FLOATING + name))
    assert [x for x in free if x not in before] == fixed
    for base, joints in before.items():
        assert (base in free) == (joints in fixed if joints else "f_ext" in fixed)
        assert base not in free or free[free.index(base) + 1] == (joints or "backend")


@all_in_one(FUNCTIONS)
def test_every_argument_is_documented_with_its_unit_or_by_the_function_that_has_it(key):
    text = inspect.getdoc(FUNCTIONS[key]).split("Args:\n")[1].split("\n\n")[0]
    entries = re.findall(r"^ {4}(\w+(?:, \w+)*): ((?:.|\n {8})*)", text, re.MULTILINE)
    written = {name: body for names, body in entries for name in names.split(", ")}
    for name in inspect.signature(FUNCTIONS[key]).parameters:
        if name in ("robot", "backend"):
            continue
        assert name in written, name
        unit = re.search(r"\[[^\]]*\]", WORDS.get(name, ""))
        if unit and "as in" not in written[name]:
            for part in unit[0].strip("[]").split(" or "):
                assert part.split(",")[0].strip("- ") in written[name], (name, unit[0])


# --- names in docs and examples --------------------------------------------------------------------------------------

# about the inside of the package, for who extends it or reads the paper
INSIDE_EXAMPLES = ("10_paper_figures", "27_mppi", "34_turn", "35_hands_shac")
INSIDE = {
    "contributing.md",
    "paper.md",
    "10_paper_figures.py",
    "27_mppi.py",
    "34_turn.py",
    "35_hands_shac.py",
    "films.py",
}
GAPS = {
    "Family",
    "GAP",
    "default_effects",
    "nominal_robot",
    "go2",
    "urdf",
    *("Manipulation", "PADS", "PERIOD", "PRESSING", "TABLE", "points_of", "task_of"),
}  # of examples, on no face yet
CODE = re.compile(r"^```(?:python|pycon)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)


def sources():
    """Python of the examples and of the code blocks on the pages, by file."""
    for path in sorted((ROOT / "examples").glob("*.py")):
        yield path, path.read_text(encoding="utf-8")
    for path in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]):
        for block in CODE.findall(path.read_text(encoding="utf-8")):
            lines = block.splitlines()
            if any(line.startswith(">>>") for line in lines):
                lines = [line[4:] for line in lines if line.startswith((">>> ", "... "))]
            yield path, "\n".join(lines)


def names_used(text):
    """Pairs (module, name) of the package that a text imports, or reads of a module that it has imported."""
    modules = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "torchdq":
                    modules[alias.asname or alias.name.split(".")[0]] = alias.name if alias.asname else "torchdq"
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torchdq":
            for alias in node.names:
                yield node.module, alias.name
                if is_module(f"{node.module}.{alias.name}"):
                    modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    modules.setdefault("torchdq", "torchdq")  # pages import it once, at their top
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            module = dotted(node.value, modules)
            if module:
                yield module, node.attr


def dotted(node, modules):
    """Module that an expression is, or none."""
    if isinstance(node, ast.Name):
        return modules.get(node.id)
    if isinstance(node, ast.Attribute):
        outer = dotted(node.value, modules)
        inner = outer and f"{outer}.{node.attr}"
        if inner and is_module(inner):
            return inner
        if outer and inspect.ismodule(getattr(importlib.import_module(outer), node.attr, None)):
            return getattr(importlib.import_module(outer), node.attr).__name__
    return None


def is_module(name):
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def is_public(module, name):
    """Whether a name is in the `__all__` of a public module, or such a module."""
    if name.startswith("__") or f"{module}.{name}" in PUBLIC or f"{module}.{name}" == "torchdq.dq.paper":
        return True
    return module in PUBLIC | {"torchdq.robot.shipped"} and name in opened(module).__all__


def test_names_in_docs_and_examples_are_public():
    used = {(path, *name) for path, text in sources() if path.name not in INSIDE for name in names_used(text)}
    hidden = [x for x in used if not is_public(*x[1:]) and x[2] not in GAPS]
    assert sorted(f"{path.relative_to(ROOT)}: {module}.{name}" for path, module, name in hidden) == []
