"""Gradient training: a Siamese network on pairs of images, a NetVLAD layer on a drive with poses.

    data.py        a class tree, a list of pairs, a sequence with poses   -> images and `Places`
    places.py      which images show one place; balanced pairs, held-out places
    augment.py     other crops, colours, blur, occluders
    losses.py      contrastive loss, weakly supervised triplet ranking loss; the hardest pairs and negatives
    network.py     the network that is trained: frozen layers, device, precision, its file of weights
    siamese.py     `train_siamese`           netvlad.py    `train_netvlad`
    loop.py        epochs, schedule, early stop, resuming     checkpoint.py    files that appear whole
    measures.py    what is measured on held-out places        card.py          the model folder and its card

Importing this package needs the extra ``train`` for the two functions alone.
"""
