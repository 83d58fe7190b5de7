"""The whole study: configuration, stages, and a runner that resumes."""
