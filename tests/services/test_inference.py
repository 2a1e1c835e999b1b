"""Inference: the network's inputs and outputs, held frames, and what is done without a network."""

import numpy as np
import pytest
from onnx import TensorProto, helper

from models.bundle import BundleError, write
from protocol.frames import DeltaFrame, StackFrame, pack
from services.inference import Inference

QUIET = np.full(120, 1e-4, np.float32)
PLACES = ((0.4, -0.2), (-0.3, 0.3))  # model units


def network():
    """drop = the stack's first image; log_sigma = log of 0.5; class logits = that image for each class, 3 up by 2."""
    reads = {"stack": (9, 24, 24), "context": (4,)}
    gives = {"drop": (1, 24, 24), "log_sigma": (1, 24, 24), "classes": (5, 24, 24)}
    ints = {"start": 0, "end": 1, "axis": 1}
    floats = {"zero": ([], [0.0]), "log_half": ([], [float(np.log(0.5))]), "up": ([1, 5, 1, 1], [0, 0, 0, 2.0, 0])}
    constants = [helper.make_tensor(name, TensorProto.INT64, [1], [v]) for name, v in ints.items()]
    constants += [helper.make_tensor(name, TensorProto.FLOAT, *values) for name, values in floats.items()]
    nodes = [
        helper.make_node("Slice", ["stack", "start", "end", "axis"], ["drop"]),
        helper.make_node("Mul", ["drop", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "log_half"], ["log_sigma"]),
        helper.make_node("Add", ["drop", "up"], ["classes"]),
    ]
    infos = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", *shape]) for name, shape in group.items()]
        for group in (reads, gives)
    )
    graph = helper.make_graph(nodes, "test", *infos, constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def made(folder, bundle, content):
    """The bundle with this as its network."""
    manifest = {k: v for k, v in bundle.manifest.items() if k not in ("schema", "files")}
    return write(folder / "b", manifest, bundle.matrices, {"full": content})


@pytest.fixture(scope="module")
def networked(bundle, tmp_path_factory):
    return made(tmp_path_factory.mktemp("bundle"), bundle, network().SerializeToString())


@pytest.fixture
def full(skin):
    return skin.model_copy(update={"network": "full"})


@pytest.fixture
def stage(full, networked):
    return Inference("palm", full, networked)


@pytest.fixture
def delta(board):
    """A frame of a touch at one of two places, or one that holds the image of such a frame."""

    def make(scan, place=0, reconstructed=0):
        frame = DeltaFrame(skin="palm", scan=scan, valid=True, touched=True, held=bool(reconstructed))
        frame.reconstructed = reconstructed or scan
        if not reconstructed:
            frame.averaged, frame.sigma, frame.tare_frames = 1, QUIET, 64.0
            frame.difference = board.disc(*PLACES[place], 0.2, 0.3).astype(np.float32)
        return frame

    return make


def run(stage, frame):
    (out,) = stage.process(frame, frozenset({"image"}))
    return out


def runs(stage):
    return stage.health().counters["networks_run"]


def stacks(stage, frame, *topics):
    return [each for each in stage.everything(frame, frozenset({"image", *topics})) if isinstance(each, StackFrame)]


def quiet(scan):
    frame = DeltaFrame(skin="palm", scan=scan, valid=True)
    frame.sigma, frame.tare_frames = QUIET, 64.0
    return frame


def test_outputs_are_scaled_to_siemens_and_lie_where_the_manifest_says(stage, delta):
    (read,) = stacks(stage, delta(1), "stack")
    out = run(stage, delta(1))
    assert out.image == pytest.approx(read.stack[0] * read.scale, rel=1e-5) and 0.05 < out.image.max() < 1
    assert out.sigma == pytest.approx(0.5 * read.scale, rel=1e-5)
    logits = np.exp(read.stack[0] + 2 * (np.arange(5) == 3)[:, None, None])
    assert out.classes == pytest.approx(logits / logits.sum(axis=0), rel=1e-4)
    assert out.origin == pytest.approx([-0.05, -0.05]) and out.metres_per_pixel == pytest.approx(0.1 / 96)
    iy, ix = np.unravel_index(int(out.image.argmax()), (24, 24))
    assert (ix, iy) == pytest.approx([12 * (1 + v) - 0.5 for v in PLACES[0]], abs=1.5)
    free = run(stage, quiet(2))
    assert free.valid and free.image.size == 0 and runs(stage) == 2


def test_a_held_frame_has_the_image_of_the_one_reconstructed(stage, delta):
    first, held = run(stage, delta(1)), run(stage, delta(2, reconstructed=1))
    assert held.held and held.valid and held.image.size == held.sigma.size == held.classes.size == 0
    assert held.reconstructed == first.reconstructed == 1 and held.noise == first.noise == pytest.approx(1e-4)
    assert len(pack(held)) < 2000, "not the image again"
    lost = run(stage, delta(9, reconstructed=8))  # frame 8 never came
    assert not lost.valid and lost.reasons == ["gap"] and lost.image.size == 0
    stage.joined("image")
    assert (run(stage, delta(10, reconstructed=1)).image == first.image).all(), "for who has just come"
    again = run(stage, delta(11, reconstructed=1))
    assert again.held and not again.image.size, "once"
    twin = Inference("palm", stage.config, stage.bundle)
    twin.load(stage.state())
    carried = run(twin, delta(12, reconstructed=1))
    assert carried.reconstructed == 1 and (carried.image == first.image).all() and runs(stage) == 1
    assert carried.residual == first.residual is not None


def test_what_nobody_wants_is_not_run_but_made_up_for(stage, delta):
    assert stage.process(delta(1), frozenset()) == [] == stage.process(delta(2, reconstructed=1), frozenset())
    assert runs(stage) == 0 and run(stage, delta(3, reconstructed=1)).image.max() > 0.05


def test_skins_that_wait_together_keep_their_own_images(full, networked, delta):
    both, frames = [Inference(name, full, networked) for name in ("palm", "arm")], [delta(1, 0), delta(1, 1)]
    alone = [run(stage, frame).image for stage, frame in zip(both, frames, strict=True)]
    assert np.abs(alone[0] - alone[1]).max() > 0.05
    Inference.together(list(zip(both, frames, strict=True)))
    for stage, frame, image in zip(both, frames, alone, strict=True):
        assert run(stage, frame).image == pytest.approx(image, abs=1e-6)
    Inference.together(list(zip(both, frames, strict=True)))
    assert run(both[0], frames[1]).image == pytest.approx(alone[1], abs=1e-6)  # not what lay ready for another frame


def test_a_stack_is_sent_to_who_asks_once_for_each_image(stage, delta):
    assert not stacks(stage, delta(1))
    (late,) = stacks(stage, delta(2, reconstructed=1), "stack")
    assert late.reconstructed == late.scan == 1 and late.stack.shape == (9, 24, 24) and late.scale > 0
    assert not stacks(stage, delta(3, reconstructed=1), "stack")
    (newer,) = stacks(stage, delta(4, 1), "stack")
    assert newer.reconstructed == 4 and (newer.stack != late.stack).any()
    stage.joined("stack")
    assert len(stacks(stage, delta(5, reconstructed=4), "stack")) == 1
    stage.joined("stack")
    assert not stacks(stage, quiet(6), "stack"), "nothing touches"


def test_without_a_network_the_one_step_image_shows_the_touch(skin, bundle, delta):
    stage = Inference("palm", skin, bundle)
    out = run(stage, delta(1))
    iy, ix = np.unravel_index(int(out.image.argmax()), out.image.shape)
    x, y = (out.origin[i] + (v + 0.5) * out.metres_per_pixel for i, v in enumerate((ix, iy)))
    assert (x, y) == pytest.approx((0.02, -0.01), abs=0.003)
    assert (out.image >= 0).all() and "no network" in stage.health().messages[0]


def test_a_network_that_is_none_or_has_weights_elsewhere_is_an_error_of_the_bundle(full, bundle, tmp_path):
    model = network()
    tensor = model.graph.initializer[3]
    tensor.ClearField("float_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "weights.bin"), ("offset", "0"), ("length", "4")):
        tensor.external_data.add(key=key, value=value)
    with pytest.raises(BundleError, match=r"network.onnx keeps weights in another file \('weights.bin'"):
        made(tmp_path, bundle, model.SerializeToString())
    with pytest.raises(BundleError, match="network.onnx is no network that can be run"):
        Inference("palm", full, made(tmp_path / "none", bundle, b"no network"))
