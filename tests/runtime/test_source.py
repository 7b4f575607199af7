"""The hash of a stage's code: what changes it and what does not."""

import pytest

from pipeline.runtime import source


@pytest.fixture
def project(tmp_path, monkeypatch):
    for folder in ("pipeline/render/cpu/csrc", "pipeline/runtime", "stages"):
        (tmp_path / folder).mkdir(parents=True)
    for folder in ("pipeline", "pipeline/render", "pipeline/runtime", "stages"):
        (tmp_path / folder / "__init__.py").write_text("")
    files = {
        "pipeline/a.py": "X = 1\n",
        "pipeline/b.py": "Y = 1\n",
        "pipeline/runtime/log.py": "Z = 1\n",
        "pipeline/render/cpu/csrc/kernel.cpp": 'int f() { return 1; } // "one"\n',
        "stages/work.py": "from pipeline.a import X\nimport pipeline.runtime.log\n",
        "stages/draw.py": "import pipeline.render\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(source, "ROOT", tmp_path)
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path / "cache"))

    def hash_of(stage):
        forget()
        return source.stage_source_hash(f"stages.{stage}")

    yield tmp_path, hash_of
    forget()


def forget():
    """What a new process does not have."""
    for cached in (source._imports, source._module_hash, source._parsed, source._record):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("pipeline/a.py", "# a comment\nX   =   1\n"),
        ("pipeline/a.py", '"""A docstring."""\nX = 1\n'),
        ("pipeline/b.py", "Y = 2  # not imported by the stage\n"),
        ("pipeline/runtime/log.py", "Z = 2\n"),
    ],
)
def test_comments_and_foreign_code_leave_the_hash(project, file, text):
    root, hash_of = project
    before = hash_of("work")
    (root / file).write_text(text)
    assert hash_of("work") == before


def test_code_that_the_stage_imports_changes_the_hash(project):
    root, hash_of = project
    before = hash_of("work")
    (root / "pipeline/a.py").write_text("X = 2\n")
    assert hash_of("work") != before


def test_kernels_count_without_their_comments(project):
    root, hash_of = project
    before = hash_of("draw")
    kernel = root / "pipeline/render/cpu/csrc/kernel.cpp"
    kernel.write_text("/* one\n */ int f() {\n  return 1; }\n")
    assert hash_of("draw") == before
    kernel.write_text("int f() { return 2; }\n")
    assert hash_of("draw") != before
    assert hash_of("work") == hash_of("work")


def test_the_matchers_sources_count_for_what_matches(project):
    root, hash_of = project
    (root / "pipeline/sfm/csrc").mkdir(parents=True)
    (root / "pipeline/sfm/nearest.py").write_text("")
    (root / "stages/match.py").write_text("import pipeline.sfm.nearest\n")
    before = hash_of("match"), hash_of("draw")
    (root / "pipeline/sfm/csrc/kernel.cpp").write_text("int f() { return 3; }\n")
    assert hash_of("match") != before[0] and hash_of("draw") == before[1]


def test_the_viewer_and_the_templates_count_for_what_makes_pages(project):
    root, hash_of = project
    viewer = root / "pipeline/reporting/viewer/viewer.min.js"
    viewer.parent.mkdir(parents=True)
    viewer.write_text("one")
    (root / "pipeline/reporting/html.py").write_text("")
    (root / "stages/page.py").write_text("import pipeline.reporting.html\n")
    before = hash_of("page"), hash_of("draw")
    viewer.write_text("two")
    assert hash_of("page") != before[0] and hash_of("draw") == before[1]
    before = hash_of("page"), hash_of("draw")
    (root / "pipeline/reporting/templates/scene").mkdir(parents=True)
    (root / "pipeline/reporting/templates/scene/page.html.jinja").write_text("three")
    assert hash_of("page") != before[0] and hash_of("draw") == before[1]


def test_the_key_of_training_covers_the_backends() -> None:
    """They are imported at first use only, which must not hide them."""
    reached = source._reachable("pipeline.training.loop.trainer")
    assert {"pipeline.render.cpu.backend", "pipeline.render.cpu.build"} <= reached


def test_a_file_is_parsed_once_and_again_when_it_changes(project, monkeypatch):
    """And what was kept is not needed: neither a damaged record nor another parser's counts."""
    root, hash_of = project
    parsed = []
    parse = source.ast.parse
    monkeypatch.setattr(
        source.ast, "parse", lambda text, filename: parsed.append(filename) or parse(text)
    )
    first = hash_of("work")
    assert len(parsed) == len(set(parsed)) >= 3
    parsed.clear()
    assert hash_of("work") == first and not parsed
    (root / "pipeline/a.py").write_text("import pipeline.b\nX = 1\n")
    assert hash_of("work") != first
    assert parsed == [str(root / "pipeline/a.py"), str(root / "pipeline/b.py")]
    (root / "pipeline/a.py").write_text("X = 1\n")
    assert hash_of("work") == first

    record = root / "cache" / source.RECORD
    kept = record.read_text()
    for damaged in ("{", "[]", kept.replace('"parser": "', '"parser": "other ')):
        assert damaged != kept
        record.write_text(damaged)
        parsed.clear()
        assert hash_of("work") == first and len(parsed) >= 3


def test_imports_inside_functions_and_branches_count(project):
    root, hash_of = project
    before = hash_of("work")
    inside = "def f():\n    try:\n        pass\n    except OSError:\n        {}\n"
    (root / "pipeline/a.py").write_text("X = 1\n" + inside.format("pass"))
    plain = hash_of("work")
    (root / "pipeline/a.py").write_text("X = 1\n" + inside.format("import pipeline.b"))
    with_b = hash_of("work")
    (root / "pipeline/b.py").write_text("Y = 2\n")
    assert len({before, plain, with_b, hash_of("work")}) == 4
