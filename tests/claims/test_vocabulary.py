"""Names, docstrings, comments, messages and pages use the terms of the glossary in docs/contributing.md.

python tests/claims/test_vocabulary.py [FOLDER ...]    prints refused words by folder, or by line of the given ones
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("README.md", "CHANGELOG.md", "docs", "examples", "benchmarks/pages", "torchdq", "envs")

# what is refused in text and what to say instead
REFUSED = {
    r"\btold\b": "identifiable, or predicted",
    r"\buntold\b": "unidentifiable",
    r"\bsought\b": "estimated",
    r"\bdoubt(s|ed|ful)?\b": "diagnostics",
    r"\banew\b": "again",
    r"\bin (the )?place of\b": "instead of",
    r"\brubb(ing|ed)\b": "friction",
    r"\bclimb": "select",
    r"\brungs?\b": "candidate",
    r"\b(the|its|their|whose) worth\b|\bworth of\b": "validation gain",
    r"\bbeside (the |an? |its )?(physics|model|description|friction|network|arm|parameters|masses)\b": "augmented",
    r"\bbod(y|ies) that can exist\b|\bthat no body has\b": "physically consistent",
    r"\bleaves? possible\b": "posterior",
    r"\b(is|are|was|were) no [a-z]+ but\b": "is not ..., but",
    r"(?<!there )\b(is|are|was|were) no (number|tensor|pose|log|file|robot|body|tree|array|function|network|program)s?"
    r"\b": "is not a",
    r"^(shipped|printed|not there) (is|are)\b": "the verb after the noun",
}
# a docstring that does not stand alone, in a hover text or an index
FRAGMENT = re.compile(r'"""(What |The same|Those |Words |Whether it |That of |How it )')
NAMES = re.compile(r"(un)?told|sought|doubt(s|ed|ful)?|beside|worth|climb(s|ed)?|rungs?|rubbing|anew")
STEMS = ("told", "sought", "doubt", "anew", "place of", "rubb", "climb", "rung", "worth", "beside", "that can exist")
STEMS += ("no body has", "possible", " no ", "shipped ", "printed ", "not there ")  # of all that is refused
WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
NO_PROSE = re.compile(r"^## Glossary$.*|^::: \S+$", re.MULTILINE | re.DOTALL)  # the glossary, names in the reference
FENCE = re.compile(r"^```\w*\n.*?^```$", re.MULTILINE | re.DOTALL)


def refused(text):
    """Patterns that a text has, each with its position."""
    text = text.lower()
    for pattern in REFUSED if any(stem in text for stem in STEMS) else ():
        for match in re.finditer(pattern, text, re.MULTILINE):
            yield match.start(), match[0], REFUSED[pattern]


def in_python(source):
    """Lines and refused words of names, strings and comments, and of docstrings that are fragments."""
    if not (FRAGMENT.search(source) or NAMES.search(source.lower()) or any(refused(source))):
        return  # most files need not be taken apart
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        line = token.start[0]
        if token.type == tokenize.NAME:
            for word in WORD.findall(token.string):
                if NAMES.fullmatch(word.lower()):
                    yield line, word.lower(), "a name of the glossary"
        elif token.type in (tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", -1)):
            for at, word, cure in refused(token.string):
                yield line + token.string.count("\n", 0, at), word, cure
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            found = FRAGMENT.match(f'"""{ast.get_docstring(node)}')
            if found:
                yield getattr(node, "lineno", 1), found[1].strip() + " ...", "a noun phrase that stands alone"


def in_page(text):
    """Lines and refused words of a page, except for its glossary and code in other languages."""
    text = NO_PROSE.sub("", text)
    for at, word, cure in refused(FENCE.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)):
        yield text.count("\n", 0, at) + 1, word, cure
    for match in FENCE.finditer(text):
        if match[0].startswith("```python"):
            first = text.count("\n", 0, match.start()) + 1
            yield from ((first + line, word, cure) for line, word, cure in in_python(match[0][10:-3]))


def files_of(room):
    """Sources and pages of a room."""
    path = ROOT / room
    return [path] if path.is_file() else sorted([*path.rglob("*.py"), *path.rglob("*.md")])


def findings(room):
    """Places of a room that have refused words."""
    for path in files_of(room):
        text = path.read_text(encoding="utf-8")
        for line, word, cure in (in_python if path.suffix == ".py" else in_page)(text):
            yield f"{path.relative_to(ROOT)}:{line}", word, cure


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_uses_the_terms_of_the_glossary(room):
    found = [f"{place}: {word!r}; say: {cure}" for place, word, cure in findings(room)]
    assert not found, "\n" + "\n".join(found)


def test_refused_words_are_noticed_and_plain_english_is_not():
    wrong = (
        "parameters not told by the log",
        "doubtful torques",
        "drawn anew",
        "q in the place of x",
        "what is no tensor",
        "friction beside the description",
        "a body that can exist",
    )
    assert all(list(refused(text)) for text in wrong)
    assert all(any(stem in pattern for stem in STEMS) for pattern in REFUSED if "^" not in pattern)
    right = "there is no tensor; worth a warning; the file beside it; it is no longer needed; the lost digits"
    assert not list(refused(right))
    names = 'def doubts(x):\n    """What x has."""\n    return UntoldRung(x)'
    assert {word for _, word, _ in in_python(names)} == {"doubts", "untold", "rung", "What ..."}
    assert list(in_page("# A\n```python\ntold = 1\n```\n## Glossary\n| told |")) == [
        (3, "told", "a name of the glossary")
    ]


if __name__ == "__main__":
    if sys.argv[1:]:
        print(*(f"{place}: {word}" for room in sys.argv[1:] for place, word, _ in findings(room)), sep="\n")
    else:
        rooms = [f"torchdq/{p.name}" for p in sorted((ROOT / "torchdq").iterdir()) if p.is_dir() and p.name[0] != "_"]
        for room in (*ROOMS, *(room for room in (*rooms, "envs") if room not in ROOMS)):
            count = Counter(word.lower() for _, word, _ in findings(room))
            print(f"{room:20s}", sum(count.values()), *(f"{word} {n}" for word, n in count.most_common()), sep="  ")
