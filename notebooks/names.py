"""What the quantities of a study are called in figures and pages."""

from analysis.records.findings import attribute_name

WORDS = {  # of quantities whose names do not say it
    "train_psnr": "PSNR on training views",
    "gaussians": "number of Gaussians",
    "lambda_max": "λ max",
    "lambda_second": "second largest λ",
    "lambda_min": "λ min",
    "eigenvalue_ratio": "λ max / λ min",
    "negative_ratio": "|λ min| / λ max",
    "finite_curvature": "curvature by steps of Adam",
    "depth_gradient": "gradient, depth : lateral",
    "needles": "share of e₁ on needles",
    "one_gaussian": "share of e₁ on one Gaussian",
    "opacity_one_view": "opacity's curvature ~ one view",
    "coadaptation": "co-adaptation",
    "ensemble": "difference of seeds",
}


def words_of(quantity: str) -> str:
    """What a quantity of a run is called in a figure.

    >>> words_of("trace_means"), words_of("one_gaussian"), words_of("share_scene")
    ('trace of position', 'share of e₁ on one Gaussian', 'share, scene units')
    """
    for metric in ("scene", "optimiser"):
        if quantity.endswith(f"_{metric}"):
            return f"{words_of(quantity.removesuffix(f'_{metric}'))}, {metric} units"
    if quantity.startswith("trace_"):
        return f"trace of {attribute_name(quantity.removeprefix('trace_'))}"
    return WORDS.get(quantity, quantity.replace("_", " "))
