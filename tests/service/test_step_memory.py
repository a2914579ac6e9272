"""A step takes no more memory than the model says, and many sizes no more than the largest."""

import json
import subprocess
import sys

import pytest

_STEPS = """
import json, sys
import numpy as np
from vergence_proto.geometry import Pose, RectifiedRig
from vergence_service.inference.model import Step, StereoView
from vergence_service.inference.onnx_model import OnnxStereoModel, packaged_weights_dir

def resident(which):
    [line] = [line for line in open("/proc/self/status") if line.startswith(which)]
    return 1024 * int(line.split()[1])

model = OnnxStereoModel(
    packaged_weights_dir(), "lite", providers=["cpu"], threads=2, allow_spinning=False
)
model.warm_up(1, 8)
before = resident("VmRSS")
most = 0
for height, width in ((240, 320), (480, 640), (64, 1600), (640, 480)):
    rig = RectifiedRig(width, height, 500.0, 500.0, width / 2, width / 2, height / 2, 0.1)
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    view = StereoView(image, image, rig, 1, Pose.identity())
    state = None
    for iterations in (8, 1, 1):
        [result] = model.step([Step(view, state, iterations)])
        most = max(most, model.step_bytes(height, width, iterations, cold=state is None))
        state = result.state
print(json.dumps([resident("VmHWM") - before, most]))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_steps_of_many_sizes_take_no_more_memory_than_the_largest_is_said_to_take() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _STEPS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    taken, said = json.loads(done.stdout)
    assert taken <= said
    assert said <= 4 * taken, "the bound says little"


_CLASSICAL_STEPS = """
import json, sys
import numpy as np
from vergence_proto.geometry import RectifiedRig
from vergence_service.inference.engines import load_model
from vergence_service.inference.model import Step, StereoView

def resident(which):
    [line] = [line for line in open("/proc/self/status") if line.startswith(which)]
    return 1024 * int(line.split()[1])

model = load_model(
    None, sys.argv[1], engine="auto", providers=["cpu"], threads=1, allow_spinning=False
)
random = np.random.default_rng(0)

def step(height, width):
    rig = RectifiedRig(width, height, 500.0, 500.0, width / 2, width / 2, height / 2, 0.1)
    left = random.integers(0, 256, (height, width, 3), np.uint8)
    view = StereoView(left, left, rig, 1)
    [result] = model.step([Step(view, None, 1)])
    model.step([Step(view, result.state if model.card.recurrent else None, 1)])
    return model.step_bytes(height, width, 1, cold=True)

step(16, 16)
before = resident("VmRSS")
most = max(step(*size) for size in json.loads(sys.argv[2]))
print(json.dumps([resident("VmHWM") - before, most]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("sgbm", [(480, 640), (200, 1600), (800, 1280)]),
        pytest.param("patchmatch", [(480, 640), (120, 1280)], marks=pytest.mark.slow),
    ],
    ids=["sgbm", "patchmatch"],
)
def test_classical_methods_take_no_more_memory_than_they_are_said_to_take(
    name: str, sizes: list[tuple[int, int]]
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CLASSICAL_STEPS, name, json.dumps(sizes)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    taken, said = json.loads(done.stdout)
    assert taken <= said, f"{taken >> 20} MiB"
    assert said <= 4 * taken, "the bound says little"
