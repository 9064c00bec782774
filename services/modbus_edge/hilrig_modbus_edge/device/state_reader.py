"""Reads the newest state of one rig into its register image."""

from hilrig_modbus_edge.device.ports import DeviceOutput
from hilrig_modbus_edge.impairment.delay_line import DelayedStates, ImpairmentSamples
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache, TimestampedPayload
from hilrig_runtime.timing.clock import Clock


class StateReader:
    """Keeps the register image of one rig up to date."""

    def __init__(self, rig: str, clock: Clock, output: DeviceOutput, states: LatestValueCache) -> None:
        self.image = StateImage()
        self.delayed: DelayedStates | None = None
        """The impaired state link; None: states are read where they are received."""
        self._rig = rig
        self._monotonic_ns = clock.monotonic_ns
        self._output = output
        self._states = states
        self._received: TimestampedPayload | None = None

    @property
    def next_ns(self) -> int | None:
        """Time at which the next state is due on the impaired link, ns, monotonic clock; None: none is in flight."""
        return None if self.delayed is None else self.delayed.line.next_ns

    @property
    def last_arrived_ns(self) -> int:
        """Arrival of the newest state at this process, ns, monotonic clock; 0: none."""
        state = self._states.get(self._rig)
        return 0 if state is None else state.arrived_ns

    def refresh(self) -> StateImage:
        """Update the register image to the newest state, and return the image."""
        state = self._states.get(self._rig)
        if self.delayed is not None:
            state = self.delayed.newest(self._monotonic_ns())
        image = self.image
        if state is not self._received and state is not None:
            self._received = state
            if not image.update(state):
                self._states.reject(f"state of {self._rig}", "not a valid state")
        return image

    def set_impairment(self, samples: ImpairmentSamples | None) -> None:
        """Delay and drop states as sampled; None: read states where they are received."""
        if samples is None:
            if self.delayed is not None:
                self.delayed = None
                self._output.follow_states(None)
        elif self.delayed is None:
            # The last served state stays the newest one until the first state is delivered.
            self.delayed = DelayedStates(samples, self._states.get(self._rig))
            self._output.follow_states(self.delayed.arrive)
        else:
            self.delayed.line.set_samples(samples)
