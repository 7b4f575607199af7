"""Paint only holes, with the user's program or without, and say what the program did wrong."""

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.config.load import scene_config
from pipeline.holes.painters import PaintCommand, inpaint, painter_of, pull_push
from pipeline.runtime.errors import UserError

IMAGE = np.full((12, 16, 3), (200, 100, 50), np.uint8)
HOLE = np.zeros((12, 16), bool)
HOLE[3:9, 4:12] = True
WEIGHTS = np.ones((12, 16))

READ = "import sys; from PIL import Image; image, mask, out = sys.argv[1:];"


def command(code: str, **limits: float) -> PaintCommand:
    return PaintCommand((sys.executable, "-c", code), **limits)


def painted(code: str, **limits: float) -> np.ndarray:
    return command(code, **limits)(IMAGE, HOLE, WEIGHTS)


def test_a_command_gets_the_image_and_a_white_mask_and_returns_its_output():
    code = (
        f"{READ} m = Image.open(mask).convert('L');"
        "r = Image.open(image); r.paste((1, 2, 3), mask=m); r.save(out)"
    )
    expected = np.where(HOLE[..., None], np.array([1, 2, 3]), IMAGE)
    np.testing.assert_array_equal(painted(code), expected)


def test_a_command_is_split_as_a_shell_does_and_run_without_one():
    found = painter_of("paint --model 'a b' $HOME; rm")
    assert isinstance(found, PaintCommand) and found.words == (
        "paint",
        "--model",
        "a b",
        "$HOME;",
        "rm",
    )


@pytest.mark.parametrize("text", ["paint 'a", '"', "  ", "a\nb", "x" * 5000])
def test_a_command_that_is_no_list_of_words_is_an_error_of_the_options(text):
    with pytest.raises(UserError, match=r"(?s)holes\.fill.* none, inpaint or a command"):
        scene_config({"holes": {"fill": text}}, "x")


SAVE = f"{READ} Image.new"


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import sys; sys.exit('no model\\nat all')", r"exit code 1.*no model\s+at all"),
        ("import os; os.abort()", "signal 6"),
        ("print('done')", r"found no file.*done"),
        (f"{SAVE}('RGB', (16, 11)).save(out)", "expected 16x12 .* found 16x11 pixels"),
        (f"{SAVE}('RGBA', (16, 12)).save(out)", "found 16x12 pixels of mode RGBA"),
        (f"{SAVE}('L', (16, 12)).save(out)", "found 16x12 pixels of mode L"),
        (f"{SAVE}('I;16', (16, 12)).save(out)", "found 16x12 pixels of mode I;16"),
        (f"{SAVE}('F', (16, 12), float('nan')).save(out, 'TIFF')", "pixels of mode F"),
        (f"{READ} open(out, 'w').write('text')", "found no readable image"),
        (f"{READ} import os; os.mkdir(out)", "found no file"),
    ],
)
def test_what_a_program_does_wrong_is_said_with_its_last_messages(code, message):
    with pytest.raises(UserError, match=f"(?s)holes.fill: .*{message}") as error:
        painted(code)
    assert "COMMAND IMAGE.png MASK.png OUTPUT.png" in str(error.value)


def test_a_truncated_image_is_an_error():
    code = (
        f"{READ} Image.effect_noise((16, 12), 50).convert('RGB').save(out);"
        "data = open(out, 'rb').read(); open(out, 'wb').write(data[:100])"
    )
    with pytest.raises(UserError, match="found no readable image"):
        painted(code)


def test_a_program_that_is_not_found_is_an_error():
    with pytest.raises(UserError, match="cannot be started: No such file or directory"):
        PaintCommand(("no-such-program",))(IMAGE, HOLE, WEIGHTS)


def test_a_program_that_hangs_is_ended_with_what_it_has_started(tmp_path):
    file = tmp_path / "child"
    code = (
        "import subprocess, sys, time, pathlib;"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']);"
        f"pathlib.Path({str(file)!r}).write_text(str(child.pid)); time.sleep(600)"
    )
    with pytest.raises(UserError, match="expected an image within 3 seconds, found none"):
        painted(code, time_limit_s=3)
    assert _has_ended(int(file.read_text()))


def _has_ended(pid: int) -> bool:
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        # A process that nobody waits for stays as a zombie where init does not collect it.
        stat = Path(f"/proc/{pid}/stat")
        if stat.is_file() and stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.1)
    return False


def test_pixels_outside_of_the_holes_are_those_of_the_image_when_inpainted():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    hole = rng.random((30, 40)) < 0.5
    found = inpaint(image, hole, np.ones((30, 40)))
    np.testing.assert_array_equal(found[~hole], image[~hole])
    assert found.dtype == np.uint8 and (found[hole] != image[hole]).any()


def test_inpainting_continues_the_pixels_that_count():
    image = IMAGE.copy()
    image[:, :4] = (0, 255, 0)  # in front
    weights = WEIGHTS.copy()
    weights[:, :4] = 0
    found = inpaint(image, HOLE, weights)
    np.testing.assert_array_equal(found[HOLE], IMAGE[HOLE])


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_a_continuation_stays_within_the_values_that_are_known(data):
    size = data.draw(st.tuples(st.integers(1, 20), st.integers(1, 20)))
    values = data.draw(hnp.arrays(np.float64, (*size, 1), elements=st.floats(-5, 5)))
    weights = data.draw(hnp.arrays(np.float64, size, elements=st.sampled_from([0.0, 1e-6, 0.5, 1])))
    weights[0, 0] = 1
    found = pull_push(values, weights)
    known = values[weights > 0]
    assert found.shape == values.shape
    assert known.min() - 1e-9 <= found.min() and found.max() <= known.max() + 1e-9
    np.testing.assert_allclose(found[weights == 1], values[weights == 1], atol=1e-12)
