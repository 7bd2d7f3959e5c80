"""A file of another tool is the same training as our own checkpoint of the same Gaussians, on the views and in the world of its
trainer; where it is not the picture of its scene, nothing is measured.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from PIL import Image

from splat.curvature.hessian import SceneHessian
from splat.model.files.splat_ply import splat_ply
from splat.model.files.tensor_files import gsplat_bytes
from splat.model.gaussians import Gaussians
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene, spread_views
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, open_checkpoint, open_subject, save_checkpoint
from splat.training.loop import train
from splat.training.origin.likeness import LEAST_PSNR, MARGIN
from splat.training.origin.options import Foreign
from splat.training.origin.presets import PRESETS
from splat.training.origin.subject import Checkpoint, SceneReference
from splat.training.state import TrainConfig, Training
from tests.refusals import refused
from tests.splat.model.files import written
from tests.splat.model.files.written import stored

OURS = "splat-landscape"
MADE = synthetic_scene(SyntheticSettings(gaussians=60, views=12, width=24, height=16))


def gaussians() -> Gaussians:
    """The truth with colours of degree 3 that are a little off, so that the loss is not at 0."""
    g = MADE.truth.select(torch.arange(len(MADE.truth)), 3)
    g.sh.add_(0.03 * torch.randn(g.sh.shape, generator=torch.Generator().manual_seed(0)))
    return g


@pytest.fixture
def folder(tmp_path) -> Path:
    write_transforms_scene(MADE.scene, tmp_path / "scene")
    return tmp_path


def opened(path: Path, train: Sequence[str] | None = None, **ask) -> Checkpoint:
    ask = {"scene": path.parents[0] / "scene", "guess_views": True, **ask}
    return open_checkpoint(path, Foreign(**ask), path, train)


def own(path: Path, scene: Path) -> Path:
    loaded = load_scene(scene)
    split = split_scene(loaded)
    training = Training.start(gaussians(), loaded.extent(split.train), TrainConfig())
    save_checkpoint(path, training, SceneReference.to(loaded, path, split, None, 1.0))
    return path


WRITTEN: dict[str, Callable[[Gaussians], bytes]] = {
    "graphdeco.ply": lambda g: written.ply(written.columns(g)),
    "gsplat.ply": lambda g: written.ply(written.columns(g, normals=False)),
    "brush.ply": written.brush,
    "chkpnt7.pth": written.graphdeco_pth,
    "ckpt_6_rank0.pt": written.gsplat_pt,
    "step-9.ckpt": written.splatfacto,
}


@pytest.mark.parametrize("name", WRITTEN)
def test_loss_gradient_and_products_are_those_of_our_own_checkpoint(folder, name):
    path = stored(folder / name, WRITTEN[name](gaussians()))
    subject = open_subject(own(folder / "own.pt", folder / "scene"))
    ours = subject.objective()
    theirs = opened(path, subject.checkpoint.scene.train, trained_by=OURS).with_scene(path).objective()
    assert torch.equal(theirs.active.flat, ours.active.flat)
    flat = ours.active.flat
    assert theirs.loss(flat) == pytest.approx(ours.loss(flat), rel=1e-5)
    torch.testing.assert_close(theirs.gradient, ours.gradient, rtol=1e-5, atol=1e-9)
    v = torch.randn(len(flat), 1, generator=torch.Generator().manual_seed(0))
    both = [SceneHessian(each).apply(v) for each in (theirs, ours)]
    torch.testing.assert_close(*both, rtol=1e-5, atol=1e-5 * float(both[1].abs().max()))


def test_a_training_continues_from_it(folder):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    found = opened(path, trained_by=OURS)
    config = replace(found.training.config, iterations=3)
    training = Training.start(found.training.gaussians, found.training.extent, config)
    views = found.with_scene(path).scene.load(found.scene.train)
    own_loss = found.with_scene(path).objective()
    before = own_loss.loss(own_loss.active.flat)
    assert [done.step for done in train(training, views)] == [1, 2, 3]
    assert not torch.equal(training.gaussians.flat, found.training.gaussians.flat) and before > 0


def test_what_is_not_the_scenes_picture_is_not_measured_and_shown(folder):
    g = gaussians()
    g.means.mul_(-1)
    path = stored(folder / "a.ply", written.ply(written.columns(g)))
    refused(r"got \d+\.\d dB on training views .*a.ply-mismatch", opened, path, trained_by=OURS)
    assert path.with_name("a.ply-mismatch.png").read_bytes().startswith(b"\x89PNG")


def faded(folder: Path, contrast: float) -> Path:
    """The scene with photographs of little contrast."""
    for path in sorted((folder / "scene" / "images").iterdir()):
        picture = np.asarray(Image.open(path)) / 255
        Image.fromarray(np.uint8(255 * (picture.mean() + contrast * (picture - picture.mean())) + 0.5)).save(path)
    return folder


def plain(colour: float) -> Gaussians:
    """Gaussians that fill every picture with one colour."""
    g = gaussians().select(torch.arange(4), 0)
    g.means.mul_(0.01)
    g.log_scales.fill_(1.0)
    g.opacity_logits.fill_(6.0)
    g.sh.fill_((colour - 0.5) * (4 * torch.pi) ** 0.5)
    return g


def test_a_picture_of_one_colour_is_no_likeness_however_low_the_contrast(folder):
    view = load_scene(faded(folder, 0.2) / "scene").load()[0]
    path = stored(folder / "a.ply", written.ply(written.columns(plain(float(view.image.mean())))))
    said = refused(r"is this their scene\?", opened, path, trained_by=OURS)
    got, least, one = map(float, re.findall(r"(\d+\.\d)(?: dB|;|\))", said))
    assert got > LEAST_PSNR and least == pytest.approx(one + MARGIN, abs=0.11)


def test_colours_far_beyond_white_are_no_likeness_of_white(folder):
    g = gaussians()
    bright = g.sh[:, 0].mean(dim=1) > 0
    g.sh[bright, 0] = 1e9
    refused(r"got -\d+\.\d dB", opened, stored(folder / "a.ply", written.ply(written.columns(g))), trained_by=OURS)


def test_an_spz_is_read_in_the_axes_in_which_it_looks_like_the_scene(folder):
    pytest.importorskip("gsply")
    g = gaussians()
    g.sh.mul_(0.4)
    turned = g.with_flat(g.flat.clone())
    turned.means.mul_(torch.tensor([1.0, -1.0, -1.0]))
    turned.quats.mul_(torch.tensor([1.0, 1.0, -1.0, -1.0]))
    signs = torch.from_numpy(written.odd_in_yz()).float()
    turned.sh[:, 1:].mul_(signs[:, None])
    both = [opened(stored(folder / f"{each is g}.spz", written.spz(each)), trained_by=OURS) for each in (g, turned)]
    assert torch.equal(both[0].training.gaussians.means, both[1].training.gaussians.means)
    notes = [" ".join((each.origin or {})["notes"]) for each in both]
    assert ["axes are those of a PLY" in each for each in notes] == [False, True]


@pytest.mark.parametrize(
    ("comments", "ask", "message"),
    [
        ((), {}, r"expected --trained-by graphdeco \(.*; one of graphdeco, gsplat.*\) for .*a\.ply.*, got none\n"),
        (("trained by someone",), {}, r"expected --trained-by .*, got 'someone' in the file\)"),
        ((), {"trained_by": "nobody"}, "got nobody; of the original 3DGS: graphdeco"),
        ((), {"trained_by": "graphdec"}, r"got graphdec; did you mean graphdeco\?"),
        ((), {"trained_by": "gsplat-1.5"}, r"got gsplat-1.5; did you mean gsplat-1.6\?"),
        ((), {"trained_by": OURS, "scene": None}, "expected --scene SCENE"),
        ((), {"trained_by": OURS, "views": 2, "train_list": Path("views.txt")}, "--views or --train-list"),
        ((), {"trained_by": OURS, "train": ("nothing",)}, "name of one view"),
        ((), {"trained_by": "nerfstudio"}, "dataparser_transforms.json"),
    ],
)
def test_what_the_file_does_not_say_is_asked_for(folder, comments, ask, message):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians()), comments))
    refused(message, opened, path, **ask)


@pytest.mark.parametrize(
    ("comments", "ask", "expected"),
    [
        (("Exported from Brush", "SplatRenderMode: mip"), {}, ("mip-plain", 0.1)),
        (("Exported from Brush", "SplatRenderMode: default"), {}, ("none", 0.3)),
        ((), {"trained_by": "gsplat-raw", "antialiased": True}, ("mip-plain", 0.3)),
        ((), {"trained_by": "graphdeco", "antialiased": True}, ("mip", 0.3)),
        (("antialiased 1",), {"trained_by": "graphdeco"}, ("mip", 0.3)),
    ],
)
def test_what_was_antialiased_is_rendered_as_its_tool_does(folder, comments, ask, expected):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians()), comments))
    found = opened(path, **ask)
    render = found.training.config.render
    assert (render.antialias, render.blur) == expected
    assert found.origin and found.origin["preset"]["render"]["antialias"] == expected[0]


def test_mip_splattings_ply_is_the_same_as_our_own_checkpoint_with_its_filter(folder):
    g = gaussians()
    g = g.with_filter(0.02 + 0.05 * torch.rand(len(g), generator=torch.Generator().manual_seed(1)))
    path = stored(folder / "m.ply", splat_ply(g))
    theirs = opened(path)
    render = theirs.training.config.render
    assert (render.antialias, render.blur) == ("mip-splatting", 0.1)
    save_checkpoint(folder / "own.pt", theirs.training, theirs.scene)
    ours = load_checkpoint(folder / "own.pt")
    both = [each.with_scene(path).objective() for each in (theirs, ours)]
    assert both[0].active.filter_widths is not None
    assert torch.equal(both[0].gradient, both[1].gradient)
    plain = theirs.training.config.objective(g.with_filter(None), both[0].views)
    assert float((plain.gradient - both[0].gradient).norm()) > 1e-3 * float(plain.gradient.norm())


def test_our_own_checkpoint_is_given_nothing_that_it_holds(folder):
    path = own(folder / "own.pt", folder / "scene")
    assert open_checkpoint(path, Foreign(scene=folder / "scene"), path).origin is None
    refused("no --trained-by", opened, path, trained_by="gsplat", guess_views=False)


def names(*numbers: int) -> list[str]:
    return [f"images/view_{i:03}.png" for i in numbers]


@pytest.mark.parametrize(
    ("settings", "cameras", "ask", "expected", "source"),
    [
        (None, None, {}, names(*range(1, 8), 9, 10, 11), "guessed"),
        (None, None, {"views": 2}, names(1, 11), "asked for"),
        (None, None, {"train": ("view_003", "view_000.png")}, names(3, 0), "as listed"),
        ("Namespace(eval=True)", None, {}, names(*range(1, 8), 9, 10, 11), "cfg_args"),
        ("Namespace(eval=False)", None, {}, names(*range(12)), "cfg_args"),
        ("Namespace(eval=True)", ["view_000", "view_002", "view_005.JPG"], {}, names(2, 5), "cameras.json"),
        ("Namespace(eval=True)", "not a list", {}, names(*range(1, 8), 9, 10, 11), "cfg_args"),
    ],
)
def test_views_are_asked_for_or_read_or_guessed_and_said(folder, settings, cameras, ask, expected, source):
    path = stored(folder / "m/point_cloud/iteration_50/point_cloud.ply", written.ply(written.columns(gaussians())))
    if settings:
        stored(folder / "m/cfg_args", settings.encode())
    if cameras:
        listed = [{"img_name": name} for name in cameras] if isinstance(cameras, list) else cameras
        stored(folder / "m/cameras.json", json.dumps(listed).encode())
    found = opened(path, scene=folder / "scene", trained_by="graphdeco", **ask)
    assert found.scene.train == expected
    assert found.origin and source in found.origin["views"]
    assert found.training.step == (50 if settings else 0)


def test_views_that_nothing_names_are_asked_for(folder):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    words = r"expected --views 3 .*--train-list.*--guess-views.* for .*a\.ply"
    refused(words, opened, path, guess_views=False, trained_by=OURS)
    path = stored(folder / "m/point_cloud/iteration_50/point_cloud.ply", path.read_bytes())
    stored(folder / "m/cfg_args", b"Namespace(sh_degree=0)")
    stored(folder / "m/cameras.json", json.dumps([{"img_name": "view_000"}]).encode())  # one that is held out
    asked = {"scene": folder / "scene", "guess_views": False, "trained_by": "graphdeco"}
    refused("expected --views 3 ", opened, path, **asked)


@pytest.mark.parametrize(
    ("ask", "more"),
    [
        ({}, "--trained-by graphdeco --views 3"),
        ({"scene": None}, "--scene SCENE --trained-by graphdeco --views 3"),
        ({"scene": None, "trained_by": "gsplat-raw"}, "--scene SCENE --views 3"),
        ({"scene": None, "views": 2}, "--scene SCENE --trained-by graphdeco"),
        ({"trained_by": "gsplat-raw"}, "--views 3"),
    ],
)
def test_all_that_is_missing_is_said_at_once_with_the_words_that_the_command_lacks(folder, ask, more):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    sentence = refused(rf", got none\n{more}$", opened, path, guess_views=False, **ask)
    assert set(re.findall(r"--(?:scene|trained-by|views)\b", sentence)) == set(re.findall(r"--[\w-]+", more))


@pytest.mark.parametrize("kind", ["ply", "gsplat"])
def test_our_own_files_name_their_views_and_hold_out_what_the_protocol_does(folder, kind):
    train = names(3, 8)
    content = splat_ply(gaussians(), train=train) if kind == "ply" else gsplat_bytes(gaussians(), 5, train=train)
    found = opened(stored(folder / "a", content), guess_views=False, trained_by=OURS)
    assert (found.scene.train, found.scene.test) == (train, names(0))
    assert found.origin and found.origin["views"] == "as the file names them"
    assert opened(folder / "a", views=2, trained_by=OURS).scene.train == names(1, 11)


@pytest.mark.parametrize("listed", ["[1]", "nothing", "[" * 10**5])
def test_a_comment_that_is_no_list_of_views_names_none(folder, listed):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians()), (f"training views {listed}",)))
    refused("got none", opened, path, guess_views=False, trained_by=OURS)


def test_nerfstudio_trains_on_nine_tenths_of_a_transforms_file(folder):
    path = stored(folder / "step-9.ckpt", written.splatfacto(gaussians()))
    assert opened(path, trained_by=OURS).scene.train == names(*range(10), 11)


def test_the_presets_conventions_reach_the_renderer_and_the_record(folder):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    found = opened(path, trained_by="gsplat-raw")
    render = found.training.config.render
    assert (render.alpha_max, render.near, render.blur) == (0.999, 0.01, 0.3)
    assert found.origin and found.origin["preset"]["render"]["alpha_max"] == 0.999
    assert found.training.config.loss.border == found.origin["preset"]["loss"]["border"] == "valid"
    assert "trained by gsplat-raw (asked for)" in found.assumptions[0]


WEIGHTS = "opacity_reg: 0.02\nscale_reg: 0.03\nssim_lambda: 0.4\n"
SPLATFACTO = "  mcmc_opacity_reg: 0.02\n  mcmc_scale_reg: 0.03\n  strategy: {}\n"
TRAINED = {"opacity_reg": "trained", "scale_reg": "trained"}


@pytest.mark.parametrize(
    ("settings", "text", "ask", "expected", "said"),
    [
        ("cfg.yml", WEIGHTS, {}, (0.4, 0.0, 0.0), "opacity_reg 0.02 and scale_reg 0.03 are not in this loss; --opa"),
        ("cfg.yml", WEIGHTS, TRAINED, (0.4, 0.02, 0.03), None),
        ("cfg.yml", WEIGHTS, {"opacity_reg": 0.5}, (0.4, 0.5, 0.0), "training's scale_reg 0.03 are not in this loss"),
        ("cfg.yml", "  opacity_reg: 0.02\n", {}, (0.2, 0.0, 0.0), None),
        ("cfg.yml", "opacity_reg: 0.02 # of\nscale_reg: .inf\n", {}, (0.2, 0.0, 0.0), None),
        ("config.yml", SPLATFACTO.format("mcmc"), TRAINED, (0.2, 0.02, 0.03), None),
        ("config.yml", SPLATFACTO.format("default"), TRAINED, (0.2, 0.0, 0.0), None),
        ("config.yml", "  use_scale_regularization: true\n", {}, (0.2, 0.0, 0.0), "elongated Gaussians is not in this"),
        ("ckpts/cfg_args", "Namespace(cap_max=9)", {}, (0.2, 0.0, 0.0), "--opacity-reg 0.01 --scale-reg 0.01 adds"),
    ],
)
def test_regularisers_are_in_the_loss_when_asked_for_or_said_to_be_missing(folder, settings, text, ask, expected, said):
    path = stored(folder / "run/ckpts/a.ply", written.ply(written.columns(gaussians())))
    stored(folder / "run" / settings, text.encode())
    found = opened(path, scene=folder / "scene", trained_by="gsplat-raw", **ask)
    loss = found.training.config.loss
    assert (loss.ssim_weight, loss.opacity_reg, loss.scale_reg) == expected and loss.border == "valid"
    assert found.origin and found.origin["preset"]["loss"]["opacity_reg"] == expected[1]
    assert [note for note in found.assumptions if "this loss" in note] == [] if said is None else True
    assert said is None or any(said in note for note in found.assumptions)


def test_weights_of_a_training_that_are_not_known_are_asked_for(folder):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    refused(r"expected --scale-reg with a number.*got trained", opened, path, trained_by=OURS, scale_reg="trained")
    stored(folder / "cfg_args", b"Namespace(cap_max=9)")
    refused(r"3DGS-MCMC's default, --opacity-reg 0\.01", opened, path, trained_by=OURS, opacity_reg="trained")


def test_3dgs_looks_through_the_middle_of_images_of_1600_px_at_most(folder, monkeypatch):
    file = folder / "scene" / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["cx"] += 0.2
    file.write_text(json.dumps(content))
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    found = opened(path, trained_by="graphdeco")
    scene = found.with_scene(path).scene
    assert {(frame.camera.cx, frame.camera.cy) for frame in scene.frames} == {(12.0, 8.0)}
    assert scene.load(found.scene.train)[0].camera.cx == 12.0
    assert opened(path, trained_by=OURS).with_scene(path).scene.frames[0].camera.cx == pytest.approx(12.2)
    monkeypatch.setitem(cast(dict, PRESETS), "graphdeco", replace(PRESETS["graphdeco"], widest=12))
    assert opened(path, trained_by="graphdeco").scene.sizes[0] == (12, 8)


def test_fewer_views_are_spread_over_the_cameras(folder):
    path = stored(folder / "a.ply", written.ply(written.columns(gaussians())))
    found = opened(path, trained_by=OURS, views="all")
    scene = found.with_scene(path).scene
    few = found.thinned(scene, 3)
    assert len(few.scene.train) == len(few.scene.sizes) == 3 and set(few.scene.train) < set(found.scene.train)
    assert few.scene.train == sorted(few.scene.train, key=found.scene.train.index)
    chosen = torch.stack([frame.camera.centre for frame in scene.select(few.scene.train)])
    first = torch.stack([frame.camera.centre for frame in scene.select(found.scene.train[:3])])
    assert torch.pdist(chosen).min() > torch.pdist(first).min()
    assert found.thinned(scene, None) is found.thinned(scene, 99) is found
    refused("at least 1 view", spread_views, scene.frames, 0)


def test_few_views_stand_for_their_neighbours_and_are_not_the_outermost(folder):
    frame = MADE.scene.frames[0]
    places = [torch.tensor([10.0 * (k // 3) + k % 3, 0.0, 0.0], dtype=torch.float64) for k in range(9)]  # three groups
    frames = [replace(frame, name=str(k), camera=replace(frame.camera, centre=at)) for k, at in enumerate(places)]
    assert sorted(spread_views(frames, 3)) == ["1", "4", "7"] and spread_views(frames, 1) == ["4"]
    assert sorted(spread_views(frames, 9)) == [str(k) for k in range(9)]
    together = [replace(frame, name=str(k)) for k in range(4)]
    assert len({*spread_views(together, 3)}) == 3
