"""What errors and warnings say, in one reviewed snapshot: tests/messages.json.

    with refused(ArgumentError):  # raises it, and says what the snapshot holds for this place in this test
        robot.replace(mass=-1)
    with warned(UserWarning):
        ...

`pytest --update-messages` (with `-n` as well) writes what the tests that ran have said; its diff is to be read. What
differs between machines is normalised: folders, addresses, lines of tests, versions, and digits of rounded results.
"""

import json
import re
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from places import ROOT, TESTS

FILE = TESTS / "messages.json"
_SAME_EVERYWHERE = [
    (r"/[^\s'\"]*?/pytest-of-[^/]+/pytest-\d+/(popen-gw\d+/)?[^/\s'\":;,)]+", "<tmp>"),
    (r"/[^\s'\":;,)]*/(site|dist)-packages", "<packages>"),
    (re.escape(str(ROOT)), "<root>"),
    (re.escape(sys.prefix), "<python>"),
    (re.escape(str(Path.home())) + r"(?=[/\s'\"]|$)", "~"),
    (r"/tmp/[^\s'\":;,)]+", "<tmp>"),
    (r"\b0x[0-9a-f]{6,}", "<address>"),
    (r"(test_\w+\.py(:|\", line |, line ))\d+", r"\1<line>"),
    (r"\b\d+\.\d+\.\d+(\+\w+)?\b", "<version>"),
    (r"-?\b\d+(\.\d+)?e-(0[89]|[1-9]\d)\b", "<rounding>"),
    (r"\b\d+\.\d{5,}(e[+-]\d+)?\b", "<number>"),
]


def normalised(text: str) -> str:
    """A message without what differs between machines."""
    for pattern, same in _SAME_EVERYWHERE:
        text = re.sub(pattern, same, text)
    return text


class Snapshot:
    """Plugin of pytest that knows which test runs, what it has said so far, and what it is to say."""

    def __init__(self, config):
        self.updating = config.getoption("--update-messages")
        self.held = (
            json.loads(FILE.read_text()) if FILE.exists() else {}
        )  # of a file, of a test: what it says, in order
        self.said: dict[str, dict[str, list[str]]] = {}
        self.collected: dict[str, list[str]] = {}  # of the files that are collected as a whole
        self.file = self.test = ""
        self.of_workers = []

    def heard(self, message: str) -> None:
        """Compare the next message of the running test to the snapshot's, where what is repeated stands once."""
        said, message = self.said.setdefault(self.file, {}).setdefault(self.test, []), normalised(message)
        if said[-1:] == [message]:
            return
        said.append(message)
        if self.updating:
            return
        held = self.held.get(self.file, {}).get(self.test, [])
        if held[len(said) - 1 : len(said)] != said[-1:]:
            expected = held[len(said) - 1] if len(said) <= len(held) else "nothing in the snapshot"
            pytest.fail(
                f"a message differs from tests/messages.json; if it is meant so: pytest --update-messages {self.file}\n"
                f"expected: {expected}\nfound:    {said[-1]}"
            )

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        self.file, _, self.test = item.nodeid.partition("::")
        self.said.get(self.file, {}).pop(self.test, None)
        try:
            result = yield
        except BaseException:
            self.said.get(self.file, {}).pop(self.test, None)  # it has not said all
            raise
        said, held = (of.get(self.file, {}).get(self.test, []) for of in (self.said, self.held))
        if not self.updating and len(said) < len(held):
            pytest.fail(f"tests/messages.json holds {len(held)} messages of this test, which has said {len(said)}")
        return result

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config, items):
        """Before any is deselected."""
        if not any("::" in argument for argument in config.args):
            for item in items:
                file, _, test = item.nodeid.partition("::")
                self.collected.setdefault(file, []).append(test)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.of_workers.append(getattr(node, "workeroutput", {}).get("messages", ({}, {})))

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["messages"] = (self.said, self.collected)
            return
        for said, collected in self.of_workers:
            self.collected.update(collected)
            for file, tests in said.items():
                self.said.setdefault(file, {}).update(tests)
        if self.updating:
            self._write()

    def _unused(self):
        """Entries of files or tests that are no more."""
        for file, tests in self.held.items():
            if not (ROOT / file).exists():
                yield from ((file, test) for test in tests)
            elif file in self.collected:
                yield from ((file, test) for test in tests.keys() - set(self.collected[file]))

    def _write(self) -> None:
        for file, test in list(self._unused()):
            del self.held[file][test]
        for file, tests in self.said.items():
            self.held.setdefault(file, {}).update(tests)
        rows = {file: dict(sorted(tests.items())) for file, tests in sorted(self.held.items()) if tests}
        FILE.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")

    def pytest_terminal_summary(self, terminalreporter):
        if not self.updating:
            for file, test in self._unused():
                terminalreporter.write_line(f"tests/messages.json has what no test says: {file}::{test}")


_snapshot: Snapshot


def install(config) -> None:
    """Make a configured pytest compare messages."""
    global _snapshot
    _snapshot = Snapshot(config)
    config.pluginmanager.register(_snapshot)


@contextmanager
def refused(error: type[BaseException] | tuple[type[BaseException], ...]):
    """Error of this class with the message of the snapshot, as `pytest.raises` gives it."""
    with pytest.raises(error) as caught:
        yield caught
    _snapshot.heard(str(caught.value))


@contextmanager
def warned(category: type[Warning] = UserWarning):
    """One warning or several of this class, each with the message of the snapshot; what was recorded."""
    with pytest.warns(category) as caught:
        yield caught
    for message in dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, category)):
        _snapshot.heard(message)
