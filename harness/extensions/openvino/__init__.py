"""Run the GGUF file of a published model on a CPU by OpenVINO: `engine = "openvino"` in a card."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="openvino",
    adds={"backends": {"openvino": "harness.extensions.openvino.registered:REGISTRATION"}},
)
