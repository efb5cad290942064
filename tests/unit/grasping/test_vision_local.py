"""A local model is loaded and generates: a tiny one with random weights, made here; its answers are nonsense."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.grasping.affordance import NameHint
from splatbot.grasping.vision import LocalModel, VisionAffordance, VisionError, VisionTimeoutError
from splatbot.grasping.vision.models import Question
from tests.unit.grasping.test_vision import scene

QUESTION = Question("Answer with JSON.", "where is the cup", [np.zeros((32, 40, 3), np.uint8)] * 2)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """LLaVA with one layer of each, a tokenizer of a few words, its processor and chat template."""
    transformers = pytest.importorskip("transformers", reason="transformers (extra vlm) is not installed")
    tokenizers = pytest.importorskip("tokenizers")
    folder = tmp_path_factory.mktemp("tiny-vlm")
    words = ["<pad>", "<unk>", "<s>", "</s>", "<image>", "USER:", "ASSISTANT:", "where", "is", "the", "cup", "{", "}"]
    plain = tokenizers.Tokenizer(
        tokenizers.models.WordLevel({word: k for k, word in enumerate(words)}, unk_token="<unk>")
    )
    plain.pre_tokenizer = tokenizers.pre_tokenizers.WhitespaceSplit()
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=plain, pad_token="<pad>", unk_token="<unk>", bos_token="<s>", eos_token="</s>",
        additional_special_tokens=["<image>"],
    )  # fmt: skip
    sizes = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = transformers.LlavaConfig(
        vision_config=transformers.CLIPVisionConfig(image_size=32, patch_size=16, projection_dim=16, **sizes),
        text_config=transformers.LlamaConfig(vocab_size=len(words), max_position_embeddings=512, **sizes),
        image_token_index=words.index("<image>"), vision_feature_layer=-1,
    )  # fmt: skip
    import torch

    torch.manual_seed(0)
    transformers.LlavaForConditionalGeneration(config).save_pretrained(folder)
    transformers.LlavaProcessor(
        image_processor=transformers.CLIPImageProcessor(size={"shortest_edge": 32}, crop_size=32),
        tokenizer=tokenizer, patch_size=16, vision_feature_select_strategy="default", num_additional_image_tokens=1,
        chat_template="{% for m in messages %}{{ m['role'] | upper }}: {% for c in m['content'] %}"
        "{% if c['type'] == 'image' %}<image> {% else %}{{ c['text'] }} {% endif %}{% endfor %}{% endfor %}ASSISTANT: ",
    ).save_pretrained(folder)  # fmt: skip
    return folder


def test_a_tiny_model_with_random_weights_loads_and_generates(tiny: Path) -> None:
    model = LocalModel(tiny, tokens=12)
    first = model.ask(QUESTION)
    assert isinstance(first, str)
    assert model.ask(QUESTION) == first  # without sampling
    assert model.name == f"vlm:{tiny.name}"


def test_the_nonsense_of_a_random_model_is_an_error_not_a_target(tiny: Path) -> None:
    with pytest.raises(VisionError, match="gives an invalid answer"):
        VisionAffordance(LocalModel(tiny, tokens=12)).locate(NameHint("red box"), scene())


def test_a_model_that_takes_too_long_is_a_time_out(tiny: Path) -> None:
    with pytest.raises(VisionTimeoutError, match="not done"):
        LocalModel(tiny, timeout=1e-6).ask(QUESTION)


def test_a_folder_that_is_no_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.json"):
        LocalModel(tmp_path)
    pytest.importorskip("transformers", reason="transformers (extra vlm) is not installed")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(VisionError, match="cannot be loaded"):
        LocalModel(tmp_path).ask(QUESTION)


def test_without_transformers_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    (tmp_path / "config.json").write_text("{}")
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(VisionError, match=r"pip install splatbot\[vlm\]"):
        LocalModel(tmp_path).ask(QUESTION)
