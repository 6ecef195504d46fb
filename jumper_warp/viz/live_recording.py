"""Stream of a growing recording to the Rerun viewer."""

import rerun as rr

from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.recording import Recording
from jumper_warp.viz.rerun import RecordingWriter, blueprint

CHUNK = 30  # Frames that are sent together


class LiveRecording:
    """Rerun stream that receives the frames of a recorder while it records, CHUNK frames at a time."""

    def __init__(self, url: str, seconds: float) -> None:
        """Connect to a server (`RerunServer.url`); seconds: expected length of the recording [s], for the time axis."""
        self._seconds = seconds
        self._sent = 0  # Frames
        self._bodies = 0  # of the sent frames
        self._stream = rr.RecordingStream("jumper-warp")
        self._stream.connect_grpc(url)

    def update(self, recorder: Recorder) -> None:
        """Send the frames that have been recorded since the last call, if they are CHUNK or more."""
        if recorder.frames - self._sent < CHUNK:
            return
        recording = recorder.recording(first=self._sent)
        if self._sent == 0:
            layout = blueprint(recording, self._seconds, "following")
            self._stream.send_blueprint(layout, make_active=True, make_default=True)
        RecordingWriter(self._stream, recording, static=self._sent == 0).write()
        self._sent = recorder.frames
        self._bodies = len(recording.bodies)

    def finish(self, recording: Recording) -> None:
        """Send the remaining frames, and everything that depends on the whole recording: trails, goals, the layout."""
        first = self._sent if len(recording.bodies) == self._bodies else 0  # blocks were added
        RecordingWriter(self._stream, recording, first=first).write()
        self._stream.send_blueprint(blueprint(recording), make_active=True, make_default=True)
        self._stream.disconnect()
