"""Registration of frames: features, relative poses by several methods, odometry, errors."""
