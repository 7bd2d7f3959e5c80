"""The methods of training by name.

3dgs            nothing is added
stablegs        images of probed Gaussians, and their agreement from probed viewpoints
sam             the gradient at the worst place near by in the space of parameters
dropgaussian    a growing random share of the Gaussians is left out of each training render
dropoutgs       the image without a random share of the Gaussians agrees with that of all
fsgs            new Gaussians between distant neighbours; depth correlates with the user's depth maps
dngaussian      depth has the shape of the user's depth maps, globally and in small patches
cor-gs          two fields: each keeps the Gaussians that the other confirms, and agrees with it between the views
newton-blocks   in place of Adam: every Gaussian's own damped Newton step, all views at once, no density control
gn-cg           in place of Adam: Gauss-Newton by conjugate gradients over all parameters, likewise
...             those of installed packages (`splat.model.plugins`)

Their published trainings are presets: `protocols.csv`, which is the table and the data at once.

    method, setting     the setting as `--set` names it, or "start", the option; empty: there is none, see the note
    published, source   the value in the released code and the line that says so, as in "owner/repository file:line"
    unit                of the numbers
    default             the value without a protocol: that of the trainings that are the same for all methods
    llff                the value with the protocol "llff", that of the code's script for LLFF with 3 views; empty: the default
    note                where ours differs, or what is not here

The lines are those of jiaw-z/CoR-GS at 1db13a4, VITA-Group/FSGS at a536a64, Fictionarry/DNGaussian at 13ecf60, xuyx55/DropoutGS
at 6ce7c0d, and for DCVL-3D/DropGaussian_release those of its copy liuhw01/DropGaussian_release at fae60cd.

>>> METHODS["stablegs"](warm_up=100).warm_up
100
"""

import csv
from functools import cache
from pathlib import Path
from typing import get_args

from landscape.errors import InputError
from splat.model.plugins import added
from splat.training.methods.corgs import CoRGS
from splat.training.methods.depth import FSGS, DNGaussian
from splat.training.methods.dropout import DropGaussian, DropoutGS
from splat.training.methods.sam import SAM
from splat.training.methods.second_order.solvers import GaussNewtonCG, NewtonBlocks
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import MethodSettings, Protocol, ThreeDGS

COMMON: Protocol = "common"
OWN = (ThreeDGS, StableGS, SAM, DropGaussian, DropoutGS, FSGS, DNGaussian, CoRGS, NewtonBlocks, GaussNewtonCG)
METHODS: dict[str, type[MethodSettings]] = {method.name: method for method in OWN}
for _name, _method in added("landscape.methods", tuple(METHODS)).items():
    if not (isinstance(_method, type) and issubclass(_method, MethodSettings) and _method.name == _name):
        raise InputError(
            f"expected a subclass of MethodSettings whose name is {_name!r}, got {_method!r}; mend its package"
        )
    METHODS[_name] = _method


@cache
def table() -> tuple[dict[str, str], ...]:
    """The rows, by column."""
    with Path(__file__).with_name("protocols.csv").open(encoding="utf-8", newline="") as file:
        return tuple(csv.DictReader(file))


def presets(method: str, protocol: Protocol) -> dict[str, str]:
    """The settings of a protocol as `--set` takes them; none of "common".  InputError where a method has no such training.

    >>> presets("dngaussian", "llff")["rates.position"], presets("dngaussian", "common")
    ('0.016', {})
    """
    if protocol not in get_args(Protocol):
        raise InputError(f"expected a protocol among {', '.join(get_args(Protocol))}, got {protocol!r}")
    if protocol == COMMON:
        return {}
    known = [row for row in table() if row[protocol]]
    found = {row["setting"]: row[protocol] for row in known if row["method"] == method}
    if not found:
        names = ", ".join(dict.fromkeys(row["method"] for row in known))
        raise InputError(f"expected a method with a published training for {protocol} ({names}), got {method!r}")
    return found
