% Check an rve.mat (docs/reference/rve.md) in MATLAB or GNU Octave: run in its folder,
%     octave --no-gui check_rve.m
% With microMaterials it also solves the RVE at a mean deformation gradient by Newton's method,
% in the numbering of the FE2 code, and prints the mean first Piola-Kirchhoff stress [MPa].
RVEdata = load('rve.mat'); mesh = RVEdata.RVEmesh; X = mesh.nodes; T = mesh.elements;
n = mesh.nNodes; sources = mesh.FE2.periodicSourceNodes; images = mesh.FE2.periodicImageNodes;
assert(isequal(size(X), [n 3]) && all(X(:,3) == 1));
assert(isequal(size(T), [mesh.nElems 6]) && isequal(unique(T(:)), (1:n)'));  % numbers from 1
assert(isequal(size(mesh.elemMats), [mesh.nElems 1]) && all(mesh.elemMats == 1));
assert(isequal(size(sources), size(images)) && size(sources, 2) == 1);
assert(isempty(intersect(sources, images)) && numel(unique(images)) == numel(images));
assert(any(sources == mesh.FE2.fixedNode));
x = reshape(X(T,1), size(T)); y = reshape(X(T,2), size(T));
twice = (x(:,2)-x(:,1)).*(y(:,3)-y(:,1)) - (x(:,3)-x(:,1)).*(y(:,2)-y(:,1));
assert(all(twice > 0));  % corners counter-clockwise
for k = 1:3  % mid-sides 12, 23, 31: nearer to the middle of their side than its ends are
  l = mod(k, 3) + 1; side = hypot(x(:,k)-x(:,l), y(:,k)-y(:,l));
  assert(all(hypot(2*x(:,3+k)-x(:,k)-x(:,l), 2*y(:,3+k)-y(:,k)-y(:,l)) < 0.5*side));
end
phi = [mesh.phi{:}]; assert(size(phi, 1) == 2*n);
off = max(max(abs([phi(2*images-1,:)-phi(2*sources-1,:); phi(2*images,:)-phi(2*sources,:)])));
assert(off <= 1e-6*max(abs(phi(:))));
points = [1/6 1/6; 2/3 1/6; 1/6 2/3]; B = cell(1, 3); weight = cell(1, 3);
for p = 1:3  % derivatives of the shape functions by X at the three points
  r = points(p,1); s = points(p,2); t = 1-r-s;
  dr = [1-4*t 4*r-1 0 4*(t-r) 4*s -4*s]; ds = [1-4*t 0 4*s-1 -4*r 4*r 4*(t-s)];
  xr = x*dr'; xs = x*ds'; yr = y*dr'; ys = y*ds'; J = xr.*ys - xs.*yr; assert(all(J > 0));
  weight{p} = J/6; e = size(T, 1); one = ones(1, 6);
  B{p} = cat(3, (ys*one.*(ones(e,1)*dr) - yr*one.*(ones(e,1)*ds))./(J*one), ...
                (xr*one.*(ones(e,1)*ds) - xs*one.*(ones(e,1)*dr))./(J*one));
end
material = sum([weight{1}; weight{2}; weight{3}]);
fprintf('%d nodes, %d elements, %d pairs, %d modes; material %.6f of %.6f mm^2\n', n, ...
        mesh.nElems, numel(images), numel(mesh.phi), material, mesh.FE2.V);
if isfield(RVEdata, 'microMaterials')
  law = RVEdata.microMaterials(1,:); c1 = law(2); c2 = law(3); K = law(7); assert(law(1) == 2);
  keep = true(2*n, 1); keep([2*images-1; 2*images]) = false;
  keep([2*mesh.FE2.fixedNode-1 2*mesh.FE2.fixedNode]) = false;
  number = cumsum(keep).*keep; number([2*images-1 2*images]) = number([2*sources-1 2*sources]);
  F = [0.97 0.01; 0 1.005]; u = reshape(((F-eye(2))*X(:,1:2)')', n, 2);
  for iteration = 1:12
    force = zeros(2*n, 1); P = zeros(2); rows = []; columns = []; values = [];
    for p = 1:3
      for k = 1:size(T, 1)
        G = squeeze(B{p}(k,:,:)); f = eye(2) + u(T(k,:),:)'*G; J = det(f); i1 = f(:)'*f(:) + 1;
        C = inv(f)'; a = 2*(c1 + 2*c2*(i1-3)); b = K*(J-1)*J - 2*c1;
        stress = a*f + b*C; w = weight{p}(k);
        D = a*eye(4) + 8*c2*f(:)*f(:)' + K*J*(2*J-1)*C(:)*C(:)';
        for i = 1:2, for j = 1:2, for q = 1:2, for l = 1:2  % dC_ij / df_ql = -C_il C_qj
          D(i+2*j-2,q+2*l-2) = D(i+2*j-2,q+2*l-2) - b*C(i,l)*C(q,j);
        end, end, end, end
        M = zeros(4, 12); M([1 3],1:2:end) = G'; M([2 4],2:2:end) = G';
        dofs = reshape([2*T(k,:)-1; 2*T(k,:)], [], 1);
        force(dofs) = force(dofs) + w*M'*stress(:); P = P + w*stress/mesh.FE2.V;
        Ke = w*M'*D*M; rows = [rows; repmat(dofs, 12, 1)];
        columns = [columns; kron(dofs, ones(12, 1))]; values = [values; Ke(:)];
      end
    end
    Z = sparse(find(number), number(number > 0), 1, 2*n, max(number));
    residual = Z'*force; du = -Z*((Z'*sparse(rows, columns, values, 2*n, 2*n)*Z)\residual);
    u = u + reshape(du, 2, n)';
    if norm(du) < 1e-11*norm(u(:)), break, end
  end
  fprintf('F11 %.3f F12 %.3f F22 %.3f, %d iterations: P11 %.9f P12 %.9f P21 %.9f P22 %.9f MPa\n', ...
          F(1,1), F(1,2), F(2,2), iteration, P(1,1), P(1,2), P(2,1), P(2,2));
end
