"""Training on pools of clips: batches, augmentation, the trainer, checkpoints and validation."""
