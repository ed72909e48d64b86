"""Reviewed snapshots of errors and warnings, one for each room: tests/<room>/messages.json.

    with refused(ArgumentError):  # raises it, and says what the snapshot holds for this test
        robot.replace(mass=-1)
    with refused(ArgumentError, name="mass", found=-1):  # "{name} must ..., found {found}" in it
        robot.replace(mass=-1)
    with warned(UserWarning):
        ...

`pytest --update-messages FILE...` (with `-n` as well) writes what the tests of these files say; its diff is to be read.
Parameters of a test that all say the same stand once. What differs between machines is normalised: folders, addresses,
lines of tests, versions, digits of rounded results, and what other libraries say.
"""

import json
import re
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from places import DATA, ROOT, TESTS

NAME = "messages.json"
_SAME_EVERYWHERE = [
    (r"/[^\s'\"]*?/pytest-of-[^/]+/pytest-\d+/(popen-gw\d+/)?[^/\s'\":;,)]+", "<tmp>"),
    (r"/[^\s'\":;,)]*/(site|dist)-packages", "<packages>"),
    (re.escape(str(DATA)), "<recordings>"),
    (re.escape(str(ROOT)), "<root>"),
    (re.escape(sys.prefix), "<python>"),
    (re.escape(str(Path.home())) + r"(?=[/\s'\"]|$)", "~"),
    (r"/tmp/[^\s'\":;,)]+", "<tmp>"),
    (r"\b0x[0-9a-f]{6,}", "<address>"),
    (r"(test_\w+\.py(:|\", line |, line ))\d+", r"\1<line>"),
    (r"\b\d+\.\d+\.\d+(\+\w+)?\b", "<version>"),
    (r"-?\b\d+(\.\d+)?e-(0[89]|[1-9]\d)\b", "<rounding>"),
    (r"\b\d+\.\d{5,}(e[+-]\d+)?\b", "<number>"),
    (r"\b\d{40,}\b", "<long number>"),
    (r"\b[0-9a-f]{64}\b", "<digest>"),
    (r"\.build-\w+", ".build-<random>"),
    (r"can't convert np\.ndarray[^;)]*", "<torch>"),
    (r"Error\(s\) in loading state_dict[^;]*", "<torch>"),
    (r"which are [\w, ]*, found (\S+) \([^)]*\)", r"which are <devices>, found \1 (<torch>)"),
    (r"XML parse error[^;]*|Error: Error opening[^;]*", "<mujoco>"),
    (r"(XacroException|ExpatError): [^;]*", "<xacro>"),
]


def normalised(text: str, named: dict[str, object]) -> str:
    """A message without what differs between machines, and with the name of each value that it must hold."""
    for name, value in named.items():
        # the article of "must be a tensor" is not the argument a
        found = re.subn(rf"(?<!\w)(?<!\bbe ){re.escape(str(value))}(?!\w)", f"{{{name}}}", text)
        assert found[1], f"{value} is not in the message: {text}"
        text = found[0]
    for pattern, same in _SAME_EVERYWHERE:
        text = re.sub(pattern, same, text)
    return text


class Snapshot:
    """Plugin of pytest that knows which test runs, what it has said so far, and what it is to say.

    `held` and `said` hold, of a file, of a test, its different messages in order; `held` has the name of a test without
    parameters where all say the same.
    """

    def __init__(self, config):
        self.updating = config.getoption("--update-messages")
        rooms = {path.parent: json.loads(path.read_text(encoding="utf-8")) for path in sorted(TESTS.glob(f"*/{NAME}"))}
        self.held = {_path(room / file): tests for room, files in rooms.items() for file, tests in files.items()}
        self.said: dict[str, dict[str, list[str]]] = {}
        self.file = self.test = ""
        self.of_workers = []

    def expected(self) -> list[str]:
        """Messages that the running test is to say."""
        held = self.held.get(self.file, {})
        return held.get(self.test) or held.get(_function(self.test), [])

    def heard(self, text: str, named: dict[str, object]) -> None:
        """Compare a message of the running test to the snapshot."""
        said, message = self.said.setdefault(self.file, {}).setdefault(self.test, []), normalised(text, named)
        if message not in said:
            said.append(message)
        if not self.updating and message not in self.expected():
            expected = "\n          ".join(self.expected()) or "nothing in the snapshot"
            pytest.fail(
                f"a message differs from {NAME} of its room; if it is meant so: pytest --update-messages {self.file}\n"
                f"expected: {expected}\nfound:    {message}"
            )

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        self.file, _, self.test = item.nodeid.partition("::")
        said = self.said.setdefault(self.file, {})
        said[self.test] = []
        try:
            result = yield
        except BaseException:
            said.pop(self.test)  # it has not said all
            raise
        if not self.updating and (missing := set(self.expected()) - set(said[self.test])):
            pytest.fail(f"{NAME} of its room holds messages that this test has not said: {sorted(missing)}")
        return result

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.of_workers.append(getattr(node, "workeroutput", {}).get("messages", {}))

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["messages"] = self.said
            return
        for said in self.of_workers:
            for file, tests in said.items():
                self.said.setdefault(file, {}).update(tests)
        if self.updating:
            self.write()

    def write(self) -> None:
        """Replace what the tests that ran have said, with all of their parameters; tests that are no more go."""
        for file, tests in self.said.items():
            ran, text, held = {_function(test) for test in tests}, (ROOT / file).read_text(), self.held.get(file, {})
            kept = [test for test in held if _function(test) not in ran and f"def {_function(test)}(" in text]
            self.held[file] = {**{test: held[test] for test in kept}, **tests}
        rooms: dict[Path, list[str]] = {}
        for file, tests in sorted(self.held.items()):
            if any(tests.values()) and (ROOT / file).exists():
                room, _, name = (ROOT / file).relative_to(TESTS).as_posix().partition("/")
                rows = [f"  {json.dumps(test)}: {_lines(said)}" for test, said in sorted(_shared(tests).items())]
                rooms.setdefault(TESTS / room, []).append(f" {json.dumps(name)}: {{\n" + ",\n".join(rows) + "\n }")
        for path in TESTS.glob(f"*/{NAME}"):
            if path.parent not in rooms:
                path.unlink()
        for room, files in rooms.items():
            (room / NAME).write_text("{\n" + ",\n".join(files) + "\n}\n", encoding="utf-8")


def _path(file: Path) -> str:
    """Path of a file as tests are named after."""
    return file.relative_to(ROOT).as_posix()


def _function(test: str) -> str:
    """Name of a test without its parameters."""
    return test.partition("[")[0]


def _shared(tests: dict[str, list[str]]) -> dict[str, list[str]]:
    """Messages of the tests of a file, once for all parameters of a test that say the same."""
    functions: dict[str, dict[str, list[str]]] = {}
    for test, says in tests.items():
        functions.setdefault(_function(test), {})[test] = says
    same = {name: all(says == next(iter(of.values())) for says in of.values()) for name, of in functions.items()}
    return {name if same[name] else test: says for name, of in functions.items() for test, says in of.items() if says}


def _lines(says: list[str]) -> str:
    """JSON of messages, each on a line of its own where there are several."""
    rows = [json.dumps(message, ensure_ascii=False) for message in says]
    return f"[{rows[0]}]" if len(rows) == 1 else "[\n   " + ",\n   ".join(rows) + "\n  ]"


_snapshot: Snapshot


def install(config) -> None:
    """Make a configured pytest compare messages."""
    global _snapshot
    _snapshot = Snapshot(config)
    config.pluginmanager.register(_snapshot)


def said(message: str) -> None:
    """Compare a text that the running test has got, in its turn among the messages."""
    _snapshot.heard(message, {})


@contextmanager
def refused(error: type[BaseException] | tuple[type[BaseException], ...], **named):
    """Error of this class with the message of the snapshot and the named values in it, as `pytest.raises` gives it."""
    with pytest.raises(error) as caught:
        yield caught
    _snapshot.heard(str(caught.value), named)


@contextmanager
def warned(category: type[Warning] = UserWarning, **named):
    """One warning or several of this class, each with the message of the snapshot; what was recorded."""
    with pytest.warns(category) as caught:
        yield caught
    for message in dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, category)):
        _snapshot.heard(message, named)
