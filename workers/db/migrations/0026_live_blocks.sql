-- The state of a training in blocks is shown with what each block has learnt in the place of the coarse scene.

-- Gaussians of each block, by number, in a file that has those of one block after those of the other; NULL of
-- any other file.
ALTER TABLE live_scenes ADD COLUMN block_gaussians integer[];
