"""Inference: the network's inputs and outputs, held frames, and what is done without a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from models.bundle import Bundle, write
from protocol.frames import DeltaFrame, ImageFrame, StackFrame, pack
from services.estimation.images.averaging import MEANS
from services.estimation.images.quality import KEPT
from services.inference import SETTLED, Inference
from services.preprocessing import Preprocessing
from services.runtime.config import Skin
from tests.services.conftest import Board

WANTED = frozenset({"image"})


def network() -> bytes:
    """drop = the stack's first image; log_sigma = log of 0.5; class logits = that image for each class, 3 up by 2."""
    inputs = [
        helper.make_tensor_value_info("stack", TensorProto.FLOAT, ["N", 9, 24, 24]),
        helper.make_tensor_value_info("context", TensorProto.FLOAT, ["N", 4]),
    ]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", c, 24, 24])
        for name, c in (("drop", 1), ("log_sigma", 1), ("classes", 5))
    ]
    constants = [
        helper.make_tensor("start", TensorProto.INT64, [1], [0]),
        helper.make_tensor("end", TensorProto.INT64, [1], [1]),
        helper.make_tensor("axis", TensorProto.INT64, [1], [1]),
        helper.make_tensor("zero", TensorProto.FLOAT, [], [0.0]),
        helper.make_tensor("log_half", TensorProto.FLOAT, [], [float(np.log(0.5))]),
        helper.make_tensor("up", TensorProto.FLOAT, [1, 5, 1, 1], [0, 0, 0, 2.0, 0]),
    ]
    nodes = [
        helper.make_node("Slice", ["stack", "start", "end", "axis"], ["drop"]),
        helper.make_node("Mul", ["drop", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "log_half"], ["log_sigma"]),
        helper.make_node("Add", ["drop", "up"], ["classes"]),
    ]
    graph = helper.make_graph(nodes, "test", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return bytes(model.SerializeToString())


@pytest.fixture(scope="module")
def networked(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    manifest = {k: v for k, v in bundle.manifest.items() if k not in ("schema", "files")}
    return write(tmp_path_factory.mktemp("bundle") / "b", manifest, bundle.matrices, {"full": network()})


@pytest.fixture
def stage(skin: Skin, networked: Bundle) -> Inference:
    return with_images_of_value(Inference("palm", skin.model_copy(update={"network": "full"}), networked))


def delta(scan: int, value: float = 0.0, held: bool = False, reconstructed: int = 0) -> DeltaFrame:
    frame = DeltaFrame(skin="palm", scan=scan, valid=True, touched=True, held=held)
    frame.reconstructed = reconstructed or scan
    if not held:
        frame.averaged, frame.difference = 1, np.array([value], np.float32)
    return frame


class OfValue:
    """An operator whose images are the difference's one value, and twice that in a pixel of the first."""

    drift = 0.0

    def __call__(self, *noise: object) -> OfValue:
        return self

    def has(self, *noise: object) -> bool:
        return True

    def stack(self, difference: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        images = np.full((9, 24, 24), difference[0], np.float32)
        images[0, 3, 17] *= 2
        return images, np.zeros(4, np.float32), 0.4


def with_images_of_value(stage: Inference) -> Inference:
    stage._operators = OfValue()  # type: ignore[assignment]
    return stage


def run(stage: Inference, frame: DeltaFrame) -> ImageFrame:
    (out,) = stage.process(frame, WANTED)
    assert isinstance(out, ImageFrame)
    return out


def test_outputs_are_scaled_to_siemens_and_classes_to_probabilities(stage: Inference) -> None:
    out = run(stage, delta(1, 0.5))
    assert out.image[3, 17] == pytest.approx(0.4) and out.image[0, 0] == pytest.approx(0.2)
    assert out.sigma == pytest.approx(0.5 * 0.4)
    assert out.classes.sum(axis=0) == pytest.approx(1)
    assert out.classes[3, 0, 0] == pytest.approx(np.exp(2) / (np.exp(2) + 4))


def test_pixels_lie_where_the_manifest_says(stage: Inference) -> None:
    out = run(stage, delta(1, 0.5))
    assert out.origin == pytest.approx([-0.05, -0.05])
    assert out.metres_per_pixel == pytest.approx(0.1 / 96)


def test_untouched_frames_run_no_network(stage: Inference) -> None:
    out = run(stage, DeltaFrame(skin="palm", scan=1, valid=True))
    assert out.image.size == 0 and out.valid
    assert stage.health().counters["networks_run"] == 0


def test_a_held_frame_has_the_image_of_the_one_reconstructed(stage: Inference) -> None:
    first = run(stage, delta(1, 0.5))
    held = run(stage, delta(2, held=True, reconstructed=1))
    assert held.held and held.valid and held.image.size == held.sigma.size == held.classes.size == 0
    assert held.reconstructed == first.reconstructed == 1 and held.noise == first.noise
    assert len(pack(held)) < 2000, "not the image again"
    lost = run(stage, delta(9, held=True, reconstructed=8))  # frame 8 never came
    assert not lost.valid and lost.reasons == ["gap"] and lost.image.size == 0
    assert stage.health().counters["networks_run"] == 1


def test_a_held_image_is_sent_again_to_who_has_just_come(stage: Inference) -> None:
    first = run(stage, delta(1, 0.5))
    assert not run(stage, delta(2, held=True, reconstructed=1)).image.size
    stage.joined("image")
    assert (run(stage, delta(3, held=True, reconstructed=1)).image == first.image).all()
    again = run(stage, delta(4, held=True, reconstructed=1))
    assert again.held and not again.image.size, "once"


def test_what_nobody_wants_is_not_run_but_made_up_for(stage: Inference) -> None:
    assert stage.process(delta(1, 0.5), frozenset()) == []
    assert stage.process(delta(2, held=True, reconstructed=1), frozenset()) == []
    assert stage.health().counters["networks_run"] == 0
    assert run(stage, delta(3, held=True, reconstructed=1)).image.max() == pytest.approx(0.4)


def test_skins_that_wait_together_share_a_run_and_keep_their_own(
    skin: Skin, networked: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = [Inference(name, skin.model_copy(update={"network": "full"}), networked) for name in ("palm", "arm")]
    alike = [with_images_of_value(stage) for stage in both]
    frames = [delta(1, 0.5), delta(1, 0.25)]
    alone = [run(stage, frame).image for stage, frame in zip(alike, frames, strict=True)]
    runs: list[int] = []
    session = alike[0]._network.session  # type: ignore[union-attr]
    counted = lambda names, feed: runs.append(len(feed["stack"])) or session.run(names, feed)  # noqa: E731
    monkeypatch.setattr(alike[0]._network, "session", type("Counted", (), {"run": staticmethod(counted)}))
    Inference.together(list(zip(alike, frames, strict=True)))
    for stage, frame, image in zip(alike, frames, alone, strict=True):
        assert run(stage, frame).image == pytest.approx(image)
    assert runs == [2]
    assert run(alike[0], frames[1]).image == pytest.approx(alone[1])  # not what lay ready for another frame
    assert runs == [2, 1]


def test_a_stack_is_sent_to_who_asks_once_for_each_image(stage: Inference) -> None:
    def asked(frame: DeltaFrame, *topics: str) -> list[StackFrame]:
        made = stage.everything(frame, frozenset({"image", *topics}))
        return [each for each in made if isinstance(each, StackFrame)]

    assert not asked(delta(1, 0.5))
    (late,) = asked(delta(2, held=True, reconstructed=1), "stack")
    assert late.reconstructed == late.scan == 1 and late.stack.max() == 1.0 and late.scale == pytest.approx(0.4)
    assert not asked(delta(3, held=True, reconstructed=1), "stack")
    (newer,) = asked(delta(4, 0.25), "stack")
    assert newer.reconstructed == 4 and newer.stack.max() == 0.5
    stage.joined("stack")
    assert len(asked(delta(5, held=True, reconstructed=4), "stack")) == 1
    stage.joined("stack")
    assert not asked(DeltaFrame(skin="palm", scan=6, valid=True), "stack"), "nothing touches"


def test_state_carries_the_held_image(stage: Inference, skin: Skin, networked: Bundle) -> None:
    first = run(stage, delta(1, 0.5))
    twin = Inference("palm", skin.model_copy(update={"network": "full"}), networked)
    twin.load(stage.state())
    held = run(twin, delta(2, held=True, reconstructed=1))
    assert held.reconstructed == 1 and (held.image == first.image).all()


def test_without_a_network_the_one_step_image_shows_the_touch(skin: Skin, bundle: Bundle, board: Board) -> None:
    pre, stage = Preprocessing("palm", skin, bundle), Inference("palm", skin, bundle)
    for _ in range(72):
        pre.process(board.frame(), WANTED)
    (frame,) = pre.process(board.frame(board.disc(0.4, -0.2, 0.2, 0.3)), WANTED)
    assert isinstance(frame, DeltaFrame)
    out = run(stage, frame)
    iy, ix = np.unravel_index(int(out.image.argmax()), out.image.shape)
    x, y = (out.origin[i] + (v + 0.5) * out.metres_per_pixel for i, v in enumerate((ix, iy)))
    assert (x, y) == pytest.approx((0.02, -0.01), abs=0.003)
    assert (out.image >= 0).all() and "no network" in stage.health().messages[0]


def test_a_bundle_that_was_tampered_with_is_refused(networked: Bundle, tmp_path: Path) -> None:
    from models.bundle import BundleError

    copy = tmp_path / "copy"
    copy.mkdir()
    for file in networked.path.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    (copy / "network.onnx").write_bytes(network() + b" ")
    with pytest.raises(BundleError, match="network.onnx"):
        Bundle.load(copy)
    assert onnx.__version__


def elsewhere(tensor: TensorProto) -> TensorProto:
    """The same tensor, with its values in a file beside."""
    tensor.ClearField("raw_data")
    tensor.ClearField("float_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "weights.bin"), ("offset", "0"), ("length", "4")):
        tensor.external_data.add(key=key, value=value)
    return tensor


def with_weights_elsewhere(where: str) -> bytes:
    model = onnx.load_from_string(network())
    if where == "initializer":
        elsewhere(model.graph.initializer[3])
    elif where == "location unsaid":
        model.graph.initializer[3].data_location = TensorProto.EXTERNAL
    else:
        constant = elsewhere(helper.make_tensor("value", TensorProto.FLOAT, [1], [0.5]))
        node = helper.make_node("Constant", [], ["half"], value=constant)
        if where == "subgraph":
            half = helper.make_tensor_value_info("half", TensorProto.FLOAT, [1])
            branch = helper.make_graph([node], "branch", [], [half])
            node = helper.make_node("If", ["zero"], ["some"], then_branch=branch, else_branch=branch)
        if where == "function":
            opsets = [helper.make_opsetid("", 17)]
            model.functions.append(helper.make_function("own", "half", [], ["half"], [node], opsets))
        else:
            model.graph.node.append(node)
    return bytes(model.SerializeToString())


@pytest.mark.parametrize("where", ["initializer", "attribute", "subgraph", "function", "location unsaid"])
def test_a_network_with_weights_in_another_file_is_refused(bundle: Bundle, tmp_path: Path, where: str) -> None:
    from models.bundle import BundleError

    manifest = {k: v for k, v in bundle.manifest.items() if k not in ("schema", "files")}
    with pytest.raises(BundleError, match=r"network.onnx keeps weights in another file \(('weights.bin'|not named)"):
        write(tmp_path / "b", manifest, bundle.matrices, {"full": with_weights_elsewhere(where)})


def test_a_field_whose_number_only_other_readers_take_hides_no_weights(
    skin: Skin, bundle: Bundle, tmp_path: Path
) -> None:
    """A tag of over 32 bits: ONNX Runtime drops those above, and reads the graph that it belongs to."""
    from models.bundle import BundleError

    plain = with_weights_elsewhere("initializer")
    tag = plain.rindex(b"\x3a", 0, plain.index(onnx.load_from_string(plain).graph.SerializeToString()))
    hidden = plain[:tag] + b"\xba\x80\x80\x80\x10" + plain[tag + 1 :]
    manifest = {k: v for k, v in bundle.manifest.items() if k not in ("schema", "files")}
    made = write(tmp_path / "b", manifest, bundle.matrices, {"full": hidden})
    with pytest.raises(BundleError, match="network.onnx is no network that can be run .*a field's tag of over 32 bits"):
        Inference("palm", skin.model_copy(update={"network": "full"}), made)


@pytest.mark.parametrize("content", [b"", b"no network", network()[:200]])
def test_a_file_that_is_no_network_is_an_error_of_the_bundle(
    skin: Skin, bundle: Bundle, tmp_path: Path, content: bytes
) -> None:
    from models.bundle import BundleError

    manifest = {k: v for k, v in bundle.manifest.items() if k not in ("schema", "files")}
    made = write(tmp_path / "b", manifest, bundle.matrices, {"full": content})
    with pytest.raises(BundleError, match="network.onnx is no network that can be run"):
        Inference("palm", skin.model_copy(update={"network": "full"}), made)


def test_a_network_of_other_inputs_than_the_matrices_make_is_refused(
    skin: Skin, networked: Bundle, tmp_path: Path
) -> None:
    import dataclasses

    from models.bundle import BundleError

    m = networked.matrices
    fewer = dataclasses.replace(m, ladder=m.ladder[:5], level=m.level[:5])
    manifest = {k: v for k, v in networked.manifest.items() if k not in ("schema", "files", "prior", "image")}
    image = {k: v for k, v in networked.manifest["image"].items() if k != "stack"}
    made = write(tmp_path / "b", {**manifest, "image": image}, fewer, {"full": network()})
    with pytest.raises(BundleError, match=r"reads \[9, 24, 24\], its matrices make \[5, 24, 24\]"):
        Inference("palm", skin.model_copy(update={"network": "full"}), made)


def test_what_a_touch_needs_is_made_while_nothing_touches(
    skin: Skin, networked: Bundle, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first image of a touch waits for no matrix, nor do those of its means."""
    pre, stage = Preprocessing("palm", skin, networked), Inference("palm", skin, networked)
    for _ in range(80):
        (quiet,) = pre.process(board.frame(), frozenset({"delta"}))
        assert isinstance(quiet, DeltaFrame)
        run(stage, quiet)
    pieces = 0
    while stage.prepare():
        pieces += 1
    assert pieces == len(MEANS) and not stage.prepare()
    too_late = "a matrix was made while an image waited for it"
    monkeypatch.setattr(stage.residual, "_condition", lambda sigma: pytest.fail(too_late))
    seen = 0
    disc = board.disc(0.2, -0.1, 0.2, 0.3)
    for _ in range(40):
        (touched,) = pre.process(board.frame(disc), frozenset({"delta"}))
        assert isinstance(touched, DeltaFrame)
        out = run(stage, touched)
        seen += out.image.size > 0 and not out.held
    assert seen >= len(MEANS)


def test_a_noise_that_changes_from_frame_to_frame_is_not_prepared_for(
    skin: Skin, networked: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Inference("palm", skin, networked)
    monkeypatch.setattr(stage.residual, "_condition", lambda sigma: pytest.fail("a matrix for nothing"))
    for k in range(30):  # another measurement fails each time
        quiet = DeltaFrame(skin="palm", scan=k, valid=True)
        quiet.sigma = np.full(120, 1e-4, np.float32)
        quiet.sigma[k] = np.inf
        run(stage, quiet)
        assert not stage.prepare()


def test_what_other_touches_displaced_is_prepared_again(skin: Skin, networked: Bundle) -> None:
    stage = Inference("palm", skin, networked)
    quiet = DeltaFrame(skin="palm", scan=1, valid=True)
    quiet.sigma = np.full(120, 1e-4, np.float32)
    for _ in range(SETTLED):
        run(stage, quiet)
    while stage.prepare():
        pass
    for k in range(KEPT):
        stage.residual.prepare(np.full(120, 1e-5 * (k + 1), np.float32))
    assert stage.prepare()
