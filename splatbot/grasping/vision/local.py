"""Local vision-language model: any image-text-to-text model of transformers in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from splatbot.errors import InputError
from splatbot.grasping.vision.models import Question, VisionError, VisionTimeoutError


class LocalModel:
    """A :class:`splatbot.grasping.vision.VisionModel` in a folder (Qwen-VL, LLaVA, SmolVLM ...).

    Nothing is downloaded, and no code from the folder is executed.

    Args:
        folder: config, weights, tokenizer and processor, as ``save_pretrained`` writes them.
        tokens: maximum number of tokens of an answer.
        timeout: limit for an answer [s], checked after each token.

    Raises:
        InputError: there is no such folder, or a number is not above 0.
    """

    def __init__(self, folder: str | Path, *, tokens: int = 400, timeout: float = 120.0) -> None:
        self._folder = Path(folder)
        self.name = f"vlm:{self._folder.name}"
        if not (self._folder / "config.json").is_file():
            hint = "give the folder of a model, with its config.json"
            raise InputError("is no model.", file=self._folder, field="folder", hint=hint)
        if tokens < 1 or not timeout > 0.0:
            raise InputError(f"are {tokens}, {timeout}.", field="tokens, timeout", hint="give numbers above 0")
        self._tokens, self._timeout = tokens, timeout
        self._loaded: tuple[Any, Any] | None = None

    def ask(self, question: Question) -> str:
        """Answer a question; see :class:`splatbot.grasping.vision.VisionModel`. The first call loads the model.

        Raises:
            VisionTimeoutError: the answer takes longer than the timeout.
            VisionError: transformers is not installed, the model cannot be loaded, or rejects the question.
        """
        import time

        import torch

        processor, model = self._loaded = self._loaded or self._load()
        begin = time.monotonic()
        try:
            inputs = processor.apply_chat_template(
                _messages(question), add_generation_prompt=True, tokenize=True, return_dict=True, return_tensors="pt"
            )
            with torch.inference_mode():
                output = model.generate(**inputs, max_new_tokens=self._tokens, do_sample=False, max_time=self._timeout)
            answer = processor.batch_decode(output[:, inputs["input_ids"].shape[1] :], skip_special_tokens=True)[0]
        except (ValueError, RuntimeError, TypeError, KeyError, IndexError, AttributeError) as error:
            raise VisionError(f"does not take the question ({error}).", field=self.name, hint=_HINT) from error
        if time.monotonic() - begin >= self._timeout:
            raise VisionTimeoutError(f"was not done within {self._timeout:g} s.", field=self.name, hint="give more")
        return str(answer)

    def _load(self) -> tuple[Any, Any]:
        try:
            from transformers import AutoModelForImageTextToText, AutoProcessor
        except ImportError as error:
            raise VisionError(
                f"needs transformers ({error}).", field=self.name, hint="pip install splatbot[vlm]"
            ) from error
        here = {"local_files_only": True, "trust_remote_code": False}
        try:
            processor = AutoProcessor.from_pretrained(self._folder, **here)
            model = AutoModelForImageTextToText.from_pretrained(self._folder, **here).eval()
        except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
            raise VisionError(f"cannot be loaded ({error}).", field=self.name, hint=_HINT) from error
        return processor, model


_HINT = "give a model for images and text, with its processor and chat template"


def _messages(question: Question) -> list[dict[str, Any]]:
    from PIL import Image

    content: list[dict[str, Any]] = [{"type": "text", "text": question.text}]
    for k, picture in enumerate(question.pictures):
        content.append({"type": "text", "text": f"Picture {k}:"})
        content.append({"type": "image", "image": Image.fromarray(picture)})
    return [
        {"role": "system", "content": [{"type": "text", "text": question.rules}]},
        {"role": "user", "content": content},
    ]
