"""The toolkit of training: backbones, augmentation, the loop, export of networks. Tasks lie beside what they train."""
