"""A window that shows an environment's pictures: `render_mode="human"` of Gymnasium."""

from __future__ import annotations

import os
from typing import Any

from uavnav.envs.drawing import Picture
from uavnav.errors import ConfigError

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")


class Viewer:
    """A window of pygame, opened with the first picture.

    Raises:
        ConfigError: pygame is not installed, or there is no screen.
    """

    def __init__(self, fps: int) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ConfigError("render_mode='human' needs pygame-ce: pip install 'uavnav[play]'") from error
        self.fps = fps
        self.pygame: Any = pygame
        self.clock = pygame.time.Clock()

    def show(self, picture: Picture) -> None:
        """Draw a picture [height, width, 3], and wait until it is due."""
        pygame, size = self.pygame, picture.shape[1::-1]
        try:
            window = pygame.display.get_surface() or pygame.display.set_mode(size)
            pygame.event.pump()
        except pygame.error as error:
            raise ConfigError(f"render_mode='human': no window ({error}); choose rgb_array") from error
        window.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
        pygame.display.flip()
        self.clock.tick(self.fps)

    def close(self) -> None:
        self.pygame.display.quit()
