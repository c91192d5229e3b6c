"""An outlet that publishes messages to a broker by MQTT 5. It needs the extra `links` (paho-mqtt)."""

import errno
import ssl
import time
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams.connections import options_of, tls_context
from torchvision_dddas.io.streams.outlets import LAST_S, KeptOutlet

if TYPE_CHECKING:
    from paho.mqtt.client import Client

WANTED = "wanted mqtt://HOST:PORT/TOPIC, or mqtts://HOST:PORT/TOPIC, which may have the options ca, cert and key"

_WAITING = 20  # messages that the client keeps until the broker confirms them; the others wait in the outlet
_CONNECT_S, _MOST_DELAY_S = 5.0, 30


class MqttOutlet(KeptOutlet):
    """Messages on a topic, each confirmed by the broker (QoS 1). The client has a thread, and connects again itself."""

    def __init__(self, host: str, port: int, topic: str, login: tuple[str, str] | None, context: ssl.SSLContext | None):
        """Raise ImportError without paho-mqtt. context: that of TLS, None without TLS."""
        from paho.mqtt import client as mqtt
        from paho.mqtt.enums import CallbackAPIVersion

        super().__init__()
        self._topic, self._told = topic, ""
        self._trouble = ""  # why there is no connection, set by the client's thread
        self._published = self._confirmed = 0
        self._client: Client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.connect_timeout = _CONNECT_S
        self._client.max_inflight_messages_set(_WAITING)
        self._client.max_queued_messages_set(_WAITING)
        self._client.reconnect_delay_set(1, _MOST_DELAY_S)
        if login is not None:
            self._client.username_pw_set(*login)
        if context is not None:
            self._client.tls_set_context(context)
        self._client.on_connect = self._connected
        refused = ", or one side does not accept the certificate of the other" if context is not None else ""
        self._client.on_connect_fail = lambda *_: self._fail(f"the broker cannot be reached{refused}")
        self._client.on_disconnect = lambda _client, _data, _flags, reason, _: self._fail(f"not connected: {reason}")
        self._client.on_publish = self._confirm
        self._client.connect_async(host, port)
        self._client.loop_start()

    def flush(self) -> None:
        """Publish while the client takes messages."""
        self.mend()
        while self._kept and self._published - self._confirmed < _WAITING:
            self._client.publish(self._topic, self._kept[0].rstrip(b"\n"), qos=1)
            self._published += 1
            self._sent()

    def mend(self) -> None:
        """Raise OSError if there is a new reason why the client is not connected, else BlockingIOError."""
        if self._client.is_connected():
            self._told = ""
            return
        if not self._trouble or self._trouble == self._told:
            raise BlockingIOError
        self._told = self._trouble
        raise OSError(errno.ENOTCONN, self._told)

    def close(self) -> None:
        """Wait a little for the broker to confirm."""
        until_s = time.monotonic() + LAST_S
        while (self._kept or self._confirmed < self._published) and time.monotonic() < until_s:
            try:
                self.flush()
            except BlockingIOError:
                pass
            except OSError:
                break
            time.sleep(0.01)
        self._lose(self._published - self._confirmed, "the broker did not confirm it")
        self._lose_all()
        self._client.disconnect()  # ends the thread, which may still wait for the broker

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _: Any) -> None:
        self._trouble = f"the broker refuses the connection: {reason}" if reason.is_failure else ""

    def _fail(self, words: str) -> None:
        self._trouble = self._trouble or words

    def _confirm(self, *_: Any) -> None:
        self._confirmed += 1


def open_mqtt(text: str, asked: str) -> MqttOutlet:
    """Open `mqtt://HOST:PORT/TOPIC`. asked: the option without its query, for the message of an InputError."""
    try:
        parts = urlsplit(text)
        host, port, topic, options = parts.hostname, parts.port or 1883, unquote(parts.path[1:]), options_of(parts)
    except ValueError:  # its words may quote a password
        raise InputError(f"{asked} is no address; {WANTED}") from None
    unknown = [name for name in options if parts.scheme == "mqtt" or name not in ("ca", "cert", "key")]
    if not host or not topic or set(topic) & set("+#\0") or unknown or parts.fragment or not all(options.values()):
        raise InputError(f"{asked} is no address{f' with {unknown[0]}' if unknown else ''}; {WANTED}")
    login = None if parts.username is None else (unquote(parts.username), unquote(parts.password or ""))
    context = None if parts.scheme == "mqtt" else tls_context(options, asked)
    try:
        return MqttOutlet(host, port, topic, login, context)
    except ImportError:
        raise InputError(f"{asked} needs paho-mqtt; pip install 'torchvision-dddas[links]'") from None
