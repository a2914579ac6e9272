"""Int8 graphs of a tier: ranges and rounding from some clips, the loss measured on others.

The clips are synthetic, like those of validation. Each graph steps through them with its own state,
so the ranges are those of recurrent use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto, TensorProto, helper

from vergence_models.config import StepKind
from vergence_models.data.clips import StereoClips
from vergence_models.data.pool import ClipPool
from vergence_models.onnx_export.pair_sums import overflowing
from vergence_models.onnx_export.quantization_plan import plan_quantization
from vergence_models.onnx_export.quantize import ByteScale, copy_of, quantized, with_weights_apart
from vergence_models.onnx_export.rounding import inputs_of
from vergence_models.progress import silent
from vergence_models.training.camera_motion import uvd_transforms
from vergence_models.training.validation import filmed
from vergence_proto.model_io import DISPARITY, LEFT, RIGHT, UVD_CURR_FROM_PREV, StateTensor

Array = NDArray[np.generic]

RANGE_CLIPS = 4
MEASURED_CLIPS = 16  # the clips after those
BATCH = 4
# A byte's step in the features moves 99 of 100 pixels by less than this. Where two hypotheses are
# equally good it may tip the choice, as the order of sums does in float32.
PARITY_PX = 0.25
MAX_LOSS = 1.03  # EPE of the int8 graph over that of the float one


class QuantizationError(RuntimeError):
    """An int8 graph loses too much accuracy, or would differ on another CPU."""


def make_int8(
    models: Mapping[StepKind, ModelProto],
    states: Sequence[StateTensor],
    pool: ClipPool,
    *,
    max_disparity_px: float,
    on_step: Callable[[str], None] = silent,
) -> tuple[dict[StepKind, ModelProto], dict[str, object]]:
    """Int8 graphs of float graphs, and their entry of the manifest.

    ``on_step`` gets the name of each part of the work before it begins.

    Raises QuantizationError if the smallest loses more than :data:`MAX_LOSS`, or if a product in
    any of them may overflow 16 bits.
    """
    clips = filmed(pool, range(RANGE_CLIPS))
    made: dict[StepKind, ModelProto] = {}
    story: dict[str, object] = {}
    for kind, whole in sorted(models.items()):
        model = with_weights_apart(whole)
        what = plan_quantization(model)
        cold = kind.at_2x > 0
        on_step(f"int8, {kind}: the ranges of activations")
        seen = steps(model, states, clips, what.measured, forget=cold)
        scales = scales_of(seen, what.measured)
        convolutions = [each for each in model.graph.node if each.output[0] in what.convolutions]
        names = sorted({each.input[0] for each in convolutions})
        on_step(f"int8, {kind}: the rounding of weights")
        seen = steps(model, states, clips, names, forget=cold)
        int8 = quantized(model, what, scales, inputs_of(seen, convolutions, model))
        if wrong := overflowing(int8):
            raise QuantizationError(f"{kind}: pair sums may overflow in {', '.join(wrong)}")
        if not made:
            on_step(f"int8, {kind}: the loss")
            before, after = (epe_px(each, states, pool, max_disparity_px) for each in (model, int8))
            if not after < MAX_LOSS * before:
                raise QuantizationError(
                    f"{kind.iterations} iterations: EPE {after:.3f} px as int8, {before:.3f} px "
                    f"before; expected less than {MAX_LOSS:g} times as much"
                )
            story = {
                "convolutions": len(what.convolutions),
                "range_clips": RANGE_CLIPS,
                "measured_clips": min(MEASURED_CLIPS, len(pool) - RANGE_CLIPS),
                "iterations": kind.iterations,
                "epe_px": round(after, 4),
                "float_epe_px": round(before, 4),
            }
        made[kind] = int8
    return made, story


def steps(
    model: ModelProto,
    states: Sequence[StateTensor],
    clips: StereoClips,
    names: Sequence[str],
    *,
    forget: bool = False,
) -> Iterator[dict[str, Array]]:
    """Step a graph through clips and yield the named tensors after every frame.

    The first frame starts cold, with ``forget`` every frame.
    """
    model = copy_of(model)
    known = {output.name for output in model.graph.output}
    model.graph.output.extend(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
        for name in names
        if name not in known
    )
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    wanted = [*names, *(tensor.output_name for tensor in states)]
    matrices = uvd_transforms(clips, clips.world_from_left).numpy()
    batch, frames, height, width, _ = clips.left.shape
    state = {t.input_name: np.zeros((batch, *t.shape(height, width)), np.float32) for t in states}
    for frame in range(frames):
        left, right = (image.numpy() for image in clips.pair(frame))
        images = {LEFT: left, RIGHT: right, UVD_CURR_FROM_PREV: matrices[:, frame]}
        found = session.run(wanted, {**images, **state})
        yield dict(zip(names, found, strict=False))
        if forget:
            continue
        state = {
            tensor.input_name: value
            for tensor, value in zip(states, found[len(names) :], strict=True)
        }


def scales_of(seen: Iterable[Mapping[str, Array]], names: Sequence[str]) -> dict[str, ByteScale]:
    """The scale of each tensor that covers all values seen."""
    low, high = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
    for found in seen:
        for name, values in found.items():
            low[name] = min(low[name], float(values.min()))
            high[name] = max(high[name], float(values.max()))
    return {name: ByteScale.of_range(low[name], high[name]) for name in names}


def epe_px(
    model: ModelProto, states: Sequence[StateTensor], pool: ClipPool, max_disparity_px: float
) -> float:
    """Mean error of a graph's disparity, in px, where the truth is known and small enough."""
    errors = []
    last = min(RANGE_CLIPS + MEASURED_CLIPS, len(pool))
    for start in range(RANGE_CLIPS, last, BATCH):
        clips = filmed(pool, range(start, min(start + BATCH, last)))
        for frame, found in enumerate(steps(model, states, clips, [DISPARITY])):
            truth = clips.disparity_px[:, frame].numpy()
            known = (truth > 0) & (truth < max_disparity_px)
            errors.append(np.abs(found[DISPARITY] - truth)[known].mean())
    return float(np.mean(errors))
