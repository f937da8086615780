"""Names of the parameters: for the command line and files, and in plain words for reports."""

from multipos.numerics.factors import MODULUS, Factor
from multipos.numerics.terms import COMPONENTS, Term

_LINEAR = tuple(Factor(axis, 1) for axis in COMPONENTS)
# What a power of one component, and a function of it, is called: of an output's own, of another.
_ALONG_OWN = {(1, ""): "scale", (2, ""): "quad", (3, ""): "cubic", (1, MODULUS): "odd"}
_ACROSS = {(1, ""): "cross", (2, ""): "square"}


def parameter_name(output: str, axis: str, term: Term) -> str:
    """Return the name of a parameter, as INTERFACE lists them: bias_ax, scale_ax, cross_ax_y."""
    if not term.factors:
        return f"bias_{output}"
    if len(term.factors) == 1:
        named = _of_one_factor(output, axis, term.factors[0])
        if named:
            return named
    if len(term.factors) == 2 and all(factor in _LINEAR for factor in term.factors):
        return f"product_{output}_{''.join(factor.variable for factor in term.factors)}"
    return f"{term}_{output}"


def _of_one_factor(output: str, axis: str, factor: Factor) -> str:
    """Return the name of a power of one component, '' where it has none of its own."""
    form = (factor.power, factor.function)
    if factor.variable == axis and form in _ALONG_OWN:
        return f"{_ALONG_OWN[form]}_{output}"
    if factor.variable in COMPONENTS and factor.variable != axis and form in _ACROSS:
        return f"{_ACROSS[form]}_{output}_{factor.variable}"
    return ""


def parameter_label(output: str, axis: str, term: Term) -> str:
    """Return a parameter in plain words, for reports."""
    name = parameter_name(output, axis, term)
    kind = name.partition("_")[0]
    words = {
        "bias": f"output of {output} at zero specific force",
        "scale": f"scale factor of {output} along {axis}",
        "cross": f"sensitivity of {output} to force along {term}",
        "quad": f"second-order coefficient of {output} along {axis}",
        "cubic": f"third-order coefficient of {output} along {axis}",
        "odd": f"odd second-order coefficient of {output} along {axis}",
        "product": f"cross-coupling of {output} with {term}",
        "square": f"sensitivity of {output} to {term}",
    }
    return words.get(kind, f"coefficient of {term} in {output}")
