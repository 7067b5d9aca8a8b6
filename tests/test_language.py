"""Language that a machine can check: US spelling everywhere, and no dialect words in prose.

``python tests/test_language.py FILE...`` checks some files, as pre-commit does.
"""

import functools
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parent.parent
_VERBS = (
    "character|discret|emphas|equal|general|initial|linear|local|maxim|minim|normal|optim|organ|parallel|recogn|"
    "regular|sanit|special|summar|synchron|uninitial|vector|visual"
)
BRITISH = re.compile(
    r"neighbour|colour|centre|\bgrey|behaviour|favour|artefact|whilst|catalogue|"
    rf"({_VERBS})is(e|ed|er|es|ing|ation)(?![a-z])|analyse(d|s)?\b|modell(ed|ing)|travell|labell(ed|ing)|"
    r"cancell(ed|ing)|\b(kilo)?metres?\b|\blicence|\bfulfil\b|programme\b",
    re.IGNORECASE,
)
DIALECT = re.compile(
    r"\btold\b|\basked for\b|\bmade by\b|\bmeetings?\b|\bagreements?\b|\bmisfits?\b|\b(what|that) is none\b|"
    r"\bcomes of it\b|\bone's\b|\blets? go of\b|\bwhat could be meant\b"
)
WORDS_OF_OTHERS = {
    "optimisation": ("bench/cylinder.py",),
    "neighbour": ("/io/", "foam", "guide/files.md"),  # OpenFOAM's file, and entry of its dictionaries
    "centre": ("/io/", "tests/cli/test_cases.py"),  # a file format's, and a mistake in a case
}
"""British words, and parts of paths where others have chosen them."""
ROUGH = ("cl_kernels/tessellation/periodic/",)
"""Where dialect words are still allowed."""
TEXT = {".py", ".cl", ".h", ".c", ".md", ".rst", ".toml", ".cff", ".yaml", ".css"}


def prose_of(path, text):
    """Return [(line, text)] of what people read: comments and strings in Python, no code spans in Markdown."""
    if path.suffix == ".py":
        kinds = {tokenize.COMMENT, tokenize.STRING}
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        return [(t.start[0], t.string) for t in tokens if t.type in kinds]
    if path.suffix in (".md", ".rst"):
        text = re.sub(r"```.*?```|``?[^`\n]*``?", lambda m: "\n" * m[0].count("\n"), text, flags=re.DOTALL)
    return list(enumerate(text.splitlines(), 1))


@functools.cache
def is_british(word):
    """Return whether a word is spelled as in Britain. Files share most of their words."""
    return BRITISH.search(word) is not None


def findings(path, name):
    """Return what is wrong in a file, as lines ``name:line: word``."""
    text, found = path.read_text(encoding="utf-8"), []
    conflict = re.search(r"^(<{7}|>{7}) ", text, re.MULTILINE)
    if conflict:
        return [f"{name}:{text.count(chr(10), 0, conflict.start()) + 1}: a conflict that git left"]
    suspicious = any(map(is_british, set(re.findall("[A-Za-z]+", text))))
    for number, line in enumerate(text.splitlines() if suspicious else (), 1):
        for word in BRITISH.finditer(line):
            allowed = WORDS_OF_OTHERS.get(word[0].lower(), ())
            if not any(part in name for part in allowed):
                found.append(f"{name}:{number}: {word[0]!r}, write it as in the US")
    if not name.startswith(ROUGH) and DIALECT.search(text):
        for first, part in prose_of(path, text):
            for word in DIALECT.finditer(part):
                number = first + part[: word.start()].count("\n")
                found.append(f"{name}:{number}: {word[0]!r}, use the field's word")
    return found


def tracked():
    """Return the names of all text files under version control."""
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard"], capture_output=True, text=True, check=False
    )
    if listed.returncode:  # no checkout
        names = [p.relative_to(ROOT).as_posix() for p in ROOT.rglob("*") if p.is_file()]
        skipped = ("build/", ".venv/", "docs/gallery/", "docs/api/generated/")
        return [name for name in names if not name.startswith(skipped)]
    return listed.stdout.split("\n")[:-1]


def checked(names):
    """Return the findings of all files among `names` that are text, but for this one."""
    files = [ROOT / name for name in names]
    return [
        line
        for path, name in zip(files, names, strict=True)
        if path.suffix in TEXT and path.is_file() and path != Path(__file__).resolve()
        for line in findings(path, name)
    ]


def test_spelling_and_words():
    found = checked(tracked())
    assert not found, "\n".join(found)


def test_check_finds_what_it_looks_for(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("The colour of `neighbours`.\nAs was told.\n`told` is code.\n")
    assert findings(page, "docs/page.md") == [
        "docs/page.md:1: 'colour', write it as in the US",
        "docs/page.md:1: 'neighbour', write it as in the US",
        "docs/page.md:2: 'told', use the field's word",
    ]
    module = tmp_path / "module.py"
    module.write_text('"""One\n\nmade by hand."""\nself.told = 1\n')
    assert findings(module, "docs/module.py") == ["docs/module.py:3: 'made by', use the field's word"]
    assert findings(module, f"{ROUGH[0]}module.py") == []
    module.write_text("<" * 7 + " HEAD\n")
    assert findings(module, "clvoro/module.py") == ["clvoro/module.py:1: a conflict that git left"]


if __name__ == "__main__":
    lines = checked([Path(name).resolve().relative_to(ROOT).as_posix() for name in sys.argv[1:]])
    print("\n".join(lines))
    raise SystemExit(bool(lines))
