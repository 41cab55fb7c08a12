"""What the core knows of the engine before anything of OpenVINO is imported."""

from harness.backends.registry import Capabilities, Registration
from harness.core import extras

REGISTRATION = Registration(
    "harness.extensions.openvino.engine:open_model",
    Capabilities(has_weights=True, samples=True),
    card_keys=("revision", "sha256", "gated", "dtype", "file", "quantisation", "system"),
    required_keys=("weights",),
    packages={"openvino_genai": "openvino-genai", "gguf": "gguf"},
    install=extras.install("openvino"),
    finds="harness.backends.weights:find_gguf",
    prepares="harness.extensions.openvino.graph:graph_of_card",
)
