"""Operators that act element by element, with broadcasting."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca

from nn_export.operators.value import Value, broadcast, broadcast_shape, layout, lift, room

Number = Value | float
Operator = Callable[..., Value]


def apply(f: Callable[..., ca.MX], *args: Number) -> Value:
    """``f`` on broadcast values.

    Only constants are left to CasADi's own broadcasting of scalars: CasADi 3.8.2 differentiates
    ``vector + sum(vector)`` wrongly unless the sum is repeated explicitly (a test shows it).
    """
    values = [lift(a) for a in args]
    shape = broadcast_shape([v.shape for v in values])
    room(*shape)
    if 0 in shape:
        return Value(shape, ca.MX.zeros(*layout(shape)))
    size = layout(shape)
    parts = [v.mx if v.shape == shape or _number(v.mx) else broadcast(v, shape).mx for v in values]
    mx = f(*parts)
    return Value(shape, mx if mx.shape == size else ca.repmat(mx, *size))


def _number(mx: ca.MX) -> bool:
    return mx.numel() == 1 and mx.is_constant()


def unary(f: Callable[[ca.MX], ca.MX]) -> Operator:
    """Operator of one tensor and no other argument."""

    def operator(self: Number) -> Value:
        return apply(f, self)

    return operator


def binary(f: Callable[[ca.MX, ca.MX], ca.MX]) -> Operator:
    """Operator of two tensors or numbers and no other argument."""

    def operator(self: Number, other: Number) -> Value:
        return apply(f, self, other)

    return operator


def where(condition: Value, self: Number, other: Number) -> Value:
    """Choice by element; the branch not taken cannot spoil the value."""

    def choose(c: ca.MX, a: ca.MX, b: ca.MX) -> ca.MX:
        return ca.if_else(c, a, b)

    return apply(choose, condition, self, other)


def add(self: Number, other: Number, *, alpha: float = 1) -> Value:
    """``self + alpha other``."""
    return apply(lambda a, b: a + (b if alpha == 1 else alpha * b), self, other)


def sub(self: Number, other: Number, alpha: float = 1) -> Value:
    """``self - alpha other``."""
    return apply(lambda a, b: a - (b if alpha == 1 else alpha * b), self, other)


def rsub(self: Number, other: Number, alpha: float = 1) -> Value:
    """``other - alpha self``."""
    return sub(other, self, alpha)


def trunc(x: ca.MX) -> ca.MX:
    """Rounding towards zero."""
    return ca.sign(x) * ca.floor(ca.fabs(x))


def div_mode(self: Number, other: Number, *, rounding_mode: str | None = None) -> Value:
    """Division, rounded down (``"floor"``), towards zero (``"trunc"``) or not."""
    rounding = {None: lambda x: x, "floor": ca.floor, "trunc": trunc}[rounding_mode]
    return apply(lambda a, b: rounding(a / b), self, other)


def clamp(self: Value, min: Number | None = None, max: Number | None = None) -> Value:
    """Limits, each of which may be missing; slope 1 at a limit and NaN stays NaN, as in torch."""
    result = self
    if min is not None:
        result = apply(lambda x, low: ca.if_else(x < low, low, x), result, min)
    if max is not None:
        result = apply(lambda x, high: ca.if_else(x > high, high, x), result, max)
    return result


def relu(self: Value) -> Value:
    """``max(x, 0)`` with slope 0 at 0, as in torch."""
    return leaky_relu(self, 0.0)


def leaky_relu(self: Value, negative_slope: float = 0.01) -> Value:
    """``x`` where positive, else ``negative_slope x``."""
    return apply(lambda x: ca.if_else(x > 0, x, negative_slope * x), self)


def hardtanh(self: Value, min_val: float = -1.0, max_val: float = 1.0) -> Value:
    """``x`` kept within two numbers, with slope 0 at both, as in torch."""
    return apply(lambda x: ca.if_else(x >= max_val, max_val, ca.if_else(x <= min_val, min_val, x)), self)


def elu(self: Value, alpha: float = 1.0, scale: float = 1.0, input_scale: float = 1.0) -> Value:
    """Exponential linear unit with torch's three factors."""

    def f(x: ca.MX) -> ca.MX:
        low = alpha * ca.expm1(input_scale * ca.if_else(x > 0, 0.0, x))
        return scale * ca.if_else(x > 0, x, low)

    return apply(f, self)


def celu(self: Value, alpha: float = 1.0) -> Value:
    """Continuously differentiable exponential linear unit."""
    return elu(self, alpha, 1.0, 1.0 / alpha)


def gelu(self: Value, *, approximate: str = "none") -> Value:
    """Gaussian error linear unit, exact or by tanh."""
    if approximate == "none":
        return apply(lambda x: 0.5 * x * (1 + ca.erf(x / math.sqrt(2))), self)
    if approximate != "tanh":
        raise ValueError(f"approximate={approximate!r} [NN-051]")
    k = math.sqrt(2 / math.pi)
    return apply(lambda x: 0.5 * x * (1 + ca.tanh(k * (x + 0.044715 * x * x * x))), self)


def sigmoid(x: ca.MX) -> ca.MX:
    """Logistic function, right to 1e-16 of itself down to exp(-350); neither it nor its slope overflows."""
    return 1 / (1 + ca.exp(-ca.if_else(x < -350, -350.0, x)))


def softplus_mx(x: ca.MX, beta: float = 1, threshold: float = 20) -> ca.MX:
    """``log(1 + exp(beta x)) / beta``, linear above the threshold as in torch."""
    return ca.if_else(beta * x > threshold, x, ca.log1p(ca.exp(ca.fmin(beta * x, threshold))) / beta)


def softplus(self: Value, beta: float = 1, threshold: float = 20) -> Value:
    """Smooth rectifier."""
    return apply(lambda x: softplus_mx(x, beta, threshold), self)


def log_sigmoid(x: ca.MX) -> ca.MX:
    """``log(1 / (1 + exp(-x)))`` without overflow."""
    low, high = ca.if_else(x > 0, 0.0, x), ca.if_else(x > 0, x, 0.0)
    return low - ca.log1p(ca.exp(low - high))


def copy(self: Value, *, dtype: str | None = None) -> Value:
    """The same values as another type; integer types cut the fraction off."""
    if dtype == "bool":
        return apply(lambda x: x != 0, self)
    if dtype in ("int64", "int32"):
        return apply(trunc, self)
    if dtype in (None, "float64", "float32"):
        return self
    raise ValueError(f"dtype={dtype!r} [NN-052]")


def _round(x: ca.MX) -> ca.MX:  # half to even, as torch does
    low = ca.floor(x)
    up = ca.logic_or(x - low > 0.5, ca.logic_and(x - low == 0.5, ca.fmod(low, 2) != 0))
    return low + up


def _fmax(a: ca.MX, b: ca.MX) -> ca.MX:  # a number wins against NaN
    return ca.if_else(ca.logic_or(a >= b, b != b), a, b)


def _fmin(a: ca.MX, b: ca.MX) -> ca.MX:
    return ca.if_else(ca.logic_or(a <= b, b != b), a, b)


def _xlogy(a: ca.MX, b: ca.MX) -> ca.MX:  # 0 log 0 = 0; slope log b at a = 0
    void = ca.logic_and(a == 0, b <= 0)
    return ca.if_else(void, 0.0, a * ca.log(ca.if_else(void, 1.0, b)))


def _ldexp(a: ca.MX, b: ca.MX) -> ca.MX:
    return a * 2.0**b


def _table() -> dict[str, Operator]:
    plain: dict[str, Callable[[ca.MX], ca.MX]] = {
        **{name: getattr(ca, name) for name in ("sin", "cos", "tan", "tanh", "exp", "log", "sqrt", "sign")},
        **{name: getattr(ca, name) for name in ("sinh", "cosh", "asin", "acos", "atan", "asinh", "acosh")},
        **{name: getattr(ca, name) for name in ("atanh", "expm1", "log1p", "erf", "floor", "ceil")},
        "abs": ca.fabs, "neg": lambda x: -x, "sigmoid": sigmoid, "reciprocal": lambda x: 1 / x,
        "rsqrt": lambda x: 1 / ca.sqrt(x), "square": lambda x: x * x, "trunc": trunc, "round": _round,
        "exp2": lambda x: ca.exp(math.log(2) * x), "log2": lambda x: ca.log(x) / math.log(2),
        "log10": ca.log10, "silu": lambda x: x * sigmoid(x), "mish": lambda x: x * ca.tanh(softplus_mx(x)),
        "log_sigmoid": log_sigmoid, "logical_not": lambda x: x == 0,
        "isnan": lambda x: x != x, "isinf": lambda x: ca.fabs(x) == math.inf,
        "signbit": lambda x: ca.logic_or(x < 0, 1 / x < 0),
        "bitwise_not": lambda x: x == 0, "sgn": ca.sign,
    }  # fmt: skip
    pairs: dict[str, Callable[[ca.MX, ca.MX], ca.MX]] = {
        "mul.Tensor": lambda a, b: a * b, "div.Tensor": lambda a, b: a / b, "atan2.default": ca.atan2,
        "mul.Scalar": lambda a, b: a * b, "div.Scalar": lambda a, b: a / b, "hypot.default": ca.hypot,
        "maximum.default": ca.fmax, "minimum.default": ca.fmin, "fmod.Scalar": ca.fmod,
        "fmod.Tensor": ca.fmod, "remainder.Scalar": lambda a, b: a - b * ca.floor(a / b),
        "remainder.Tensor": lambda a, b: a - b * ca.floor(a / b), "pow.Tensor_Scalar": lambda a, b: a**b,
        "pow.Tensor_Tensor": lambda a, b: a**b, "pow.Scalar": lambda a, b: a**b,
        "bitwise_and.Tensor": lambda a, b: ca.logic_and(a, b),
        "bitwise_or.Tensor": lambda a, b: ca.logic_or(a, b), "logical_and.default": ca.logic_and,
        "logical_or.default": ca.logic_or, "logical_xor.default": lambda a, b: (a != 0) != (b != 0),
        "bitwise_xor.Tensor": lambda a, b: (a != 0) != (b != 0), "fmax.default": _fmax,
        "fmin.default": _fmin, "xlogy.Tensor": _xlogy, "ldexp.Tensor": _ldexp,
        "copysign.Tensor": ca.copysign,
    }  # fmt: skip
    comparisons: dict[str, Callable[[ca.MX, ca.MX], ca.MX]] = {
        "gt": lambda a, b: a > b, "ge": lambda a, b: a >= b, "lt": lambda a, b: a < b,
        "le": lambda a, b: a <= b, "eq": lambda a, b: a == b, "ne": lambda a, b: a != b,
    }  # fmt: skip
    table = {f"aten.{name}.default": unary(f) for name, f in plain.items()}
    table |= {f"aten.{name}": binary(f) for name, f in pairs.items()}
    table |= {f"aten.{n}.{kind}": binary(f) for n, f in comparisons.items() for kind in ("Scalar", "Tensor")}
    return table


OPERATORS: dict[str, Operator] = _table() | {
    "aten.add.Tensor": add, "aten.add.Scalar": add, "aten.sub.Tensor": sub, "aten.sub.Scalar": sub,
    "aten.rsub.Scalar": rsub, "aten.rsub.Tensor": rsub, "aten.div.Tensor_mode": div_mode,
    "aten.div.Scalar_mode": div_mode, "aten.clamp.default": clamp, "aten.clamp.Tensor": clamp,
    "aten.clamp_min.default": clamp, "aten.where.self": where, "aten.relu.default": relu,
    "aten.leaky_relu.default": leaky_relu, "aten.hardtanh.default": hardtanh, "aten.elu.default": elu,
    "aten.celu.default": celu, "aten.gelu.default": gelu, "aten.softplus.default": softplus,
    "aten._to_copy.default": copy,
}  # fmt: skip
