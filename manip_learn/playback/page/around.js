// What a user stated of the scene, as stated: a face is a patch, and a floor reaches to the rim of the picture.

function thingGroup({ kind, name, size, pose, mesh }) {
  const group = Object.assign(new THREE.Group(), { matrixAutoUpdate: false }), isFace = kind === "face", isFloor = isFace && name === "floor";
  // a face lies across y, out of which it looks
  const geometry = isFace ? new THREE.PlaneGeometry(...size).rotateX(-Math.PI / 2) : shapeGeometry({ kind, size, mesh: 0 }, mesh ? [meshGeometry(mesh)] : []);
  const skin = new THREE.MeshStandardMaterial({ transparent: true, opacity: isFloor ? 0.1 : 0.5, depthWrite: false, side: THREE.DoubleSide, roughness: 0.8, ...behind(0) });
  const edge = new THREE.LineBasicMaterial({ toneMapped: false });
  onTheme(() => [skin, edge].forEach((ink) => ink.color.copy(linear(pageColour("--around")))));
  group.add(Object.assign(new THREE.Mesh(geometry, skin), { renderOrder: isFloor ? 1 : 4 }));
  if (!isFloor) group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 30), edge));
  group.matrix.copy(matrixFromRows(pose));
  return group;
}

function addAround(show) {
  for (const rollout of show.rollouts) {
    rollout.things = rollout.around.map((described) => ({ name: described.name, group: thingGroup(described) }));
    for (const { group } of rollout.things) rollout.instance.root.add(group);
  }
}
