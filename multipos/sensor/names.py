"""Names of the parameters: for the command line and files, and in plain words for reports."""

from multipos.numerics.factors import MODULUS, Factor
from multipos.numerics.terms import COMPONENTS, Term


def parameter_name(output: str, axis: str, term: Term) -> str:
    """Return the name of a parameter, as INTERFACE lists them: bias_ax, scale_ax, cross_ax_y."""
    if not term.factors:
        return f"bias_{output}"
    if len(term.factors) == 1:
        factor = term.factors[0]
        own = factor.variable == axis
        if factor == Factor(factor.variable, 1) and factor.variable in COMPONENTS:
            return f"scale_{output}" if own else f"cross_{output}_{factor.variable}"
        if factor == Factor(factor.variable, 2) and factor.variable in COMPONENTS:
            return f"quad_{output}" if own else f"square_{output}_{factor.variable}"
        if own and factor == Factor(axis, 3):
            return f"cubic_{output}"
        if own and factor == Factor(axis, 1, MODULUS):
            return f"odd_{output}"
    force = [f for f in term.factors if f.variable in COMPONENTS]
    pair = [f.variable for f in force if f == Factor(f.variable, 1)]
    if len(pair) == len(term.factors) == 2:
        return f"product_{output}_{''.join(pair)}"
    return f"{term}_{output}"


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
