"""Docstrings of the package as Markdown, and public members that reading the sources alone does not show."""

import ast
import copy
import re
import textwrap
from collections.abc import Iterable, Iterator

import griffe

PARTS = {
    "Args": "Arguments",
    "Returns": "Returns",
    "Raises": "Errors",
    "Warns": "Warnings",
    "Attributes": "Attributes",
    "Fields": "Fields",
}
ENTRY = re.compile(r" {4}([^\s:][^:\n]*):\s+(.*)")


def markdown(text: str) -> str:
    """Markdown of a docstring: lists of arguments and errors; examples as code with their results as comments."""
    found, lines = [], text.split("\n")
    while lines:
        line = lines.pop(0)
        if line.removesuffix(":") in PARTS and line.endswith(":"):
            found += ["", f"**{PARTS[line[:-1]]}**", "", *_entries(_while(lines, lambda s: s[:1] in ("", " "))), ""]
        elif line.startswith(">>> "):
            found += ["", *_example([line, *_while(lines, bool)]), ""]
        else:
            found.append(line if line.startswith("    ") else _prose(line))
    return re.sub(r"\n{3,}", "\n\n", "\n".join(found)).strip()


def _prose(line: str) -> str:
    """Line whose brackets are units and shapes, not links."""
    return "`".join(part if k % 2 else part.replace("[", "\\[") for k, part in enumerate(line.split("`")))


def _while(lines: list[str], wanted) -> Iterator[str]:
    while lines and wanted(lines[0]):
        yield lines.pop(0)


def _entries(lines: Iterable[str]) -> Iterator[str]:
    """Items of a list: `name, name: what they are`, each with the lines below it."""
    for line in lines:
        if entry := ENTRY.fullmatch(line):
            names = ", ".join(f"`{name}`" for name in entry[1].split(", "))
            yield f"* {names}: {_prose(entry[2])}"
        elif line.startswith("    ") and not line.startswith("     "):
            yield f"* {_prose(line.strip())}"
        else:
            yield f"  {_prose(line.strip())}" if line.strip() else ""


def _example(lines: Iterable[str]) -> list[str]:
    """Block of code that can be copied; what it prints stands in comments."""
    code = [line[4:] if re.match(r">>>|\.\.\.( |$)", line) else f"# {line}" for line in lines]
    return ["```python", *code, "```"]


class Documented(griffe.Extension):
    """Package as the pages show it: `torchdq.envs` in its place, comments on fields as their documents."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **_) -> None:
        """Package with everything public in it."""
        if pkg.name != "torchdq":
            return
        pkg.set_member("envs", loader.load("envs"))  # the folder lies beside the package, and is installed in it
        classes = [x for x in _objects(pkg) if x.is_class]
        for one in classes:
            _take_methods(one, pkg)
            _document_fields(one)
        overriding = [(one, name) for one in classes for name in _overriding(one)]
        for one, name in overriding:
            one.del_member(name)
        for found in list(_objects(pkg)):
            if found.docstring:
                found.docstring.value = markdown(found.docstring.value)


def _objects(inside: griffe.Object) -> Iterator[griffe.Object]:
    yield inside
    for member in list(inside.members.values()):
        if not member.is_alias:
            yield from _objects(member)


def _take_methods(one: griffe.Class, package: griffe.Module) -> None:
    """Methods of a class that are functions of other modules, as `lock` of Robot: the first argument is the object."""
    for statement in ast.parse(textwrap.dedent("\n".join(one.lines))).body[0].body:
        if not isinstance(statement, ast.Assign):
            continue
        target, value = statement.targets[0], statement.value
        several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        for name, taken in zip(target.elts, value.elts, strict=True) if several else [(target, value)]:
            match taken.args[0] if isinstance(taken, ast.Call) and taken.args else taken:
                case ast.Attribute(ast.Name(module), attribute) if one.module.members.get(module, one).is_alias:
                    path = f"{one.module.members[module].target_path}.{attribute}"
                    function = _at(path, package)
                    if function:
                        one.set_member(name.id, _method(name.id, function))


def _at(path: str, package: griffe.Module) -> griffe.Function | None:
    """Function of the package at a path; None: there is none."""
    try:
        found = package[path.removeprefix("torchdq.")]
    except KeyError:
        return None
    return found if found.is_function else None


def _method(name: str, function: griffe.Function) -> griffe.Function:
    taken = copy.copy(function)
    taken.name = name
    taken.parameters = griffe.Parameters(*list(function.parameters)[1:])
    taken.docstring = function.docstring and griffe.Docstring(function.docstring.value, parent=taken)
    return taken


def _document_fields(one: griffe.Class) -> None:
    """Fields at the end of a class's document, from the comments behind them; private ones are no arguments."""
    fields = []
    for name, field in list(one.members.items()):
        if not field.is_attribute or "property" in field.labels:
            continue
        if name.startswith("_"):
            one.del_member(name)
        elif not field.docstring and field.lineno:
            _, comment, text = one.module.lines[field.lineno - 1].partition("  # ")
            if comment and not text.startswith(("type:", "noqa")):
                fields.append(f"    {name}: {text}")
    if fields and one.docstring:
        one.docstring.value += "\n\nFields:\n" + "\n".join(fields)


def _overriding(one: griffe.Class) -> list[str]:
    """Methods that a base of the package documents."""
    bases = [base for base in one.mro() if base.path.startswith("torchdq.")]
    methods = [name for name, x in one.members.items() if x.is_function and not name.startswith("__")]
    return [name for name in methods if any(name in base.members for base in bases)]
