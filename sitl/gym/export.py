"""Writes policies as ONNX files that the law `policy` flies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from companion.config.policy import CARD, PolicyCard

Layer = tuple[npt.NDArray[Any], npt.NDArray[Any]]
"""Weight (inputs, outputs) and bias (outputs)."""


def mark(model: onnx.ModelProto, card: PolicyCard, path: Path) -> None:
    """Write a model with its card. It has one input, 1 x observations, and one output, 1 x actions, both float32."""
    helper.set_model_props(model, {CARD: card.model_dump_json()})
    onnx.save(model, path)


def write_policy(layers: Sequence[Layer], card: PolicyCard, path: Path) -> None:
    """Write a network of fully connected layers, each followed by tanh."""
    nodes, weights, last = [], [], "observation"
    for number, layer in enumerate(layers):
        names = [f"weight{number}", f"bias{number}"]
        arrays = zip(layer, names, strict=True)
        weights += [numpy_helper.from_array(np.asarray(array, np.float32), name) for array, name in arrays]
        out = "action" if number == len(layers) - 1 else f"layer{number}"
        nodes.append(helper.make_node("Gemm", [last, *names], [f"sum{number}"]))
        nodes.append(helper.make_node("Tanh", [f"sum{number}"], [out]))
        last = out
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size])
        for name, size in (("observation", len(card.observations)), ("action", len(card.actions)))
    ]
    graph = helper.make_graph(nodes, "policy", ports[:1], ports[1:], weights)
    opsets = [helper.make_opsetid("", 17)]
    mark(helper.make_model(graph, opset_imports=opsets, ir_version=9), card, path)
