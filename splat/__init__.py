"""3D Gaussian Splatting with exact second derivatives: scenes, a renderer, training, and the loss's Hessian.

    Gaussians, Camera           n Gaussians over one flat vector of parameters; a pinhole camera
    View, load_scene            a camera with its picture; a scene of them from a folder of any usual format
    split_scene                 names of training and test views by the protocols of the field
    SyntheticSettings, synthetic_scene    a small scene whose Gaussians are known
    LossSettings                the loss of an image against its picture
    initial_gaussians           the start of a training, from points or at random
    TrainConfig, Training, train    what a training does; its state; its steps
    METHODS                     what a training adds to 3DGS, by name
    evaluate                    PSNR, SSIM, LPIPS of views
    open_subject                a run, a checkpoint or another tool's file, with its scene
    Foreign                     what another tool's file does not say
    load_checkpoint             the training of one of our own, whose scene need not be there
    SceneObjective              the mean loss over views as a function of the Gaussians' parameters
    SceneHessian                its Hessian as an operator for the estimators of `landscape`
    exact_traces                the traces of its blocks

Each name is imported from its module when it is first used; its docstring has an example.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
