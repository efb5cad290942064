"""The bus: latest values, bounded queues, counts of dropped messages, threads and asyncio alike."""

from __future__ import annotations

import asyncio
import threading

import pytest

from splatbot.services.bus import Bus


def test_a_new_reader_begins_with_the_latest_value_of_each_topic() -> None:
    bus = Bus()
    for value in range(3):
        bus.publish("a", value)
    bus.publish("b", "x")
    with bus.subscribe("a", "b") as reader:
        assert [(m.topic, m.value, m.number) for m in (reader.get(0), reader.get(0)) if m] == [
            ("a", 2, 3),
            ("b", "x", 1),
        ]
        assert reader.get(0) is None
    with bus.subscribe("a", latched=False) as reader:
        assert reader.get(0) is None


def test_the_readers_of_a_topic_are_those_whose_patterns_match_until_they_close() -> None:
    bus = Bus()
    one, other = bus.subscribe("maps/*"), bus.subscribe("arms/*")
    assert bus.readers_of("maps/desk") == {one}
    other.close()
    assert bus.readers_of("arms/fake") == frozenset()


def test_a_pattern_takes_topics_that_come_later() -> None:
    bus = Bus()
    with bus.subscribe("maps/*/result") as reader:
        bus.publish("maps/desk/result", 1)
        bus.publish("maps/desk/state", 2)
        bus.publish("maps/shelf/result", 3)
        assert [m.value for m in (reader.get(0), reader.get(0)) if m] == [1, 3]
        assert reader.get(0) is None


def test_a_slow_reader_loses_the_oldest_and_knows_how_many_of_what() -> None:
    bus = Bus()
    slow, fast = bus.subscribe("a", "b", capacity=3), bus.subscribe("a", "b", capacity=100)
    bus.publish("b", "first")
    for value in range(10):
        bus.publish("a", value)
    assert [m.value for m in (slow.get(0), slow.get(0), slow.get(0)) if m] == [7, 8, 9]
    assert slow.dropped == {"b": 1, "a": 7}
    assert bus.dropped == {"b": 1, "a": 7}
    assert fast.dropped == {}


def test_a_waiting_thread_is_woken_by_a_message_and_by_closing() -> None:
    bus = Bus()
    reader = bus.subscribe("a")
    got: list[object] = []
    both = threading.Event()

    def read() -> None:
        for message in reader:
            got.append(message.value)
            if len(got) == 2:
                both.set()

    thread = threading.Thread(target=read)
    thread.start()
    bus.publish("a", 1)
    bus.publish("a", 2)
    assert both.wait(5)
    reader.close()
    thread.join(5)
    assert (got, thread.is_alive(), bus.readers) == ([1, 2], False, 0)


def test_asyncio_receives_what_a_thread_publishes_in_order_and_ends_when_closed() -> None:
    bus = Bus()

    def write(n: int) -> None:
        for value in range(n):
            bus.publish("a", value)

    async def read() -> list[int]:
        got = []
        with bus.subscribe("a", capacity=1000) as reader:
            writer = asyncio.get_running_loop().run_in_executor(None, write, 500)
            async for message in reader:
                got.append(message.value)
                if len(got) == 500:
                    reader.close()
            await writer
        return got

    assert asyncio.run(asyncio.wait_for(read(), 20)) == list(range(500))


def test_a_reader_that_gave_up_waiting_loses_nothing() -> None:
    bus = Bus()

    async def read() -> object:
        with bus.subscribe("a") as reader:
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(reader.receive(), 0.01)
            bus.publish("a", "kept")
            message = await asyncio.wait_for(reader.receive(), 5)
            return message.value if message else None

    assert asyncio.run(read()) == "kept"


def test_a_reader_whose_event_loop_has_died_does_not_stop_the_writer() -> None:
    bus = Bus()
    reader = bus.subscribe("a")
    loop = asyncio.new_event_loop()
    task = loop.create_task(reader.receive())
    loop.run_until_complete(asyncio.sleep(0.01))
    loop.close()
    bus.publish("a", 1)
    assert bus.latest("a") is not None
    assert not task.done()
    task._log_destroy_pending = False  # type: ignore[attr-defined]


def test_every_reader_sees_the_writers_order_whoever_writes() -> None:
    bus = Bus()
    readers = [bus.subscribe("a", capacity=10_000) for _ in range(3)]

    def write() -> None:
        for _ in range(500):
            bus.publish("a", None)

    writers = [threading.Thread(target=write) for _ in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    for reader in readers:
        numbers = [m.number for _ in range(2000) if (m := reader.get(0))]
        assert numbers == list(range(1, 2001))


def test_what_is_forgotten_is_no_longer_latched() -> None:
    bus = Bus()
    bus.publish("maps/desk/state", 1)
    bus.publish("maps/shelf/state", 2)
    bus.forget("maps/desk/")
    assert bus.topics() == ("maps/shelf/state",)
    assert bus.latest("maps/desk/state") is None


def test_a_queue_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Bus().subscribe("a", capacity=0)


def test_a_closed_bus_ends_its_readers_and_those_that_come_later() -> None:
    bus = Bus()
    before = bus.subscribe("a")
    bus.close()
    bus.publish("a", 1)
    assert before.get(5) is None
    assert bus.subscribe("a").get(5) is None
