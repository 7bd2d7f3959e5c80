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

>>> METHODS["stablegs"](warm_up=100).warm_up
100
"""

from landscape.errors import InputError
from splat.model.plugins import added
from splat.training.methods.corgs import CoRGS
from splat.training.methods.depth.dngaussian import DNGaussian
from splat.training.methods.depth.fsgs import FSGS
from splat.training.methods.dropout.dropgaussian import DropGaussian
from splat.training.methods.dropout.dropoutgs import DropoutGS
from splat.training.methods.sam import SAM
from splat.training.methods.second_order.gn_cg import GaussNewtonCG
from splat.training.methods.second_order.newton_blocks import NewtonBlocks
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import MethodSettings, ThreeDGS

METHODS: dict[str, type[MethodSettings]] = {
    method.name: method
    for method in (
        ThreeDGS,
        StableGS,
        SAM,
        DropGaussian,
        DropoutGS,
        FSGS,
        DNGaussian,
        CoRGS,
        NewtonBlocks,
        GaussNewtonCG,
    )
}
for _name, _method in added("landscape.methods", tuple(METHODS)).items():
    if not (isinstance(_method, type) and issubclass(_method, MethodSettings) and _method.name == _name):
        raise InputError(
            f"expected a subclass of MethodSettings whose name is {_name!r}, got {_method!r}; mend its package"
        )
    METHODS[_name] = _method
